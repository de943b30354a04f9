"""`BodyHandTokenizer`: what the tokenizers with two body tokens and one hand token per four frames share.

They differ in what encoders and decoders see; streams, columns, rates and what a clip without hands lacks are
the same, so that H2VQ and its ablation compare fairly.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.models.tokenizer.base import Stream, Tokenizer
from motionloom.models.tokenizer.config import H2VQConfig, SeparateConfig


class BodyHandTokenizer(Tokenizer):
    """Streams "body" and "hand". Subclasses set `decoder` and implement `codebooks` and `_quantize`."""

    body_columns: Tensor
    hand_columns: Tensor

    def __init__(self, config: H2VQConfig | SeparateConfig, layout: MotionLayout) -> None:
        if not layout.has_part("hand"):
            raise UserError(
                f"layout {layout.name} has no hand columns; use kind 'vq' or 'rvq' with part 'body'"
            )
        streams = (Stream("body", config.num_codes, 2), Stream("hand", config.num_codes, 1))
        super().__init__(config, layout, config.part, streams, ("body", "body", "hand"))
        columns = layout.part(config.part)
        body, hand = (np.searchsorted(columns, layout.part(part)) for part in ("body", "hand"))
        self.register_buffer("body_columns", torch.from_numpy(body))
        self.register_buffer("hand_columns", torch.from_numpy(hand))

    def _missing(self, present: Tensor | None) -> dict[str, Tensor]:
        return {} if present is None else {"hand": ~present[:, self.hand_columns].all(1)}

    def _join(self, vectors: dict[str, Tensor]) -> Tensor:
        return torch.cat([vectors["body"], vectors["hand"].repeat_interleave(2, dim=1)], dim=-1)
