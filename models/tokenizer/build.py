"""From a config to a tokenizer."""

from __future__ import annotations

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.tokenizer.config import H2VQConfig, RvqConfig, VqConfig
from motionloom.models.tokenizer.h2vq import H2VQ
from motionloom.models.tokenizer.single import SingleTokenizer


def build_tokenizer(config: H2VQConfig | VqConfig | RvqConfig, layout: MotionLayout) -> Tokenizer:
    """An untrained tokenizer for motion of `layout`; `UserError` if the layout lacks the part."""
    return H2VQ(config, layout) if isinstance(config, H2VQConfig) else SingleTokenizer(config, layout)
