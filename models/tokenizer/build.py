"""From a config to a tokenizer."""

from __future__ import annotations

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.tokenizer.body_hand import H2VQ, SeparateVQ
from motionloom.models.tokenizer.config import (
    AnyTokenizerConfig,
    FsqConfig,
    H2VQConfig,
    MqConfig,
    SeparateConfig,
    Tm2tConfig,
)
from motionloom.models.tokenizer.single import FsqTokenizer, MotionQuantizer, SingleTokenizer
from motionloom.models.tokenizer.tm2t import Tm2tQuantizer


def build_tokenizer(config: AnyTokenizerConfig, layout: MotionLayout) -> Tokenizer:
    """An untrained tokenizer for motion of `layout`; `UserError` if the layout lacks the part."""
    if isinstance(config, H2VQConfig):
        return H2VQ(config, layout)
    if isinstance(config, SeparateConfig):
        return SeparateVQ(config, layout)
    if isinstance(config, FsqConfig):
        return FsqTokenizer(config, layout)
    if isinstance(config, Tm2tConfig):
        return Tm2tQuantizer(config, layout)
    if isinstance(config, MqConfig):
        return MotionQuantizer(config, layout)
    return SingleTokenizer(config, layout)
