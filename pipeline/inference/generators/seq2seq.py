"""Motion of text by a GRU over motion tokens (TM2T)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.models.baselines.tm2t.seq2seq import Seq2Seq, draw_tokens
from motionloom.models.gpt.drawing import Drawing
from motionloom.pipeline.contract.generation import GenerationRequest
from motionloom.pipeline.inference.generators.of_tokens import OfTokens
from motionloom.pipeline.store.networks import TrainedTokenizer, device_of


@dataclass(frozen=True)
class Seq2SeqGenerator(OfTokens):
    """Tokens drawn word by word, then decoded."""

    net: Seq2Seq
    given: Mapping[str, Any]
    method = "seq2seq"
    modalities = frozenset({"text"})
    settings = frozenset({"temperature", "top_k", "top_p"})

    @property
    def tokenizer(self) -> TrainedTokenizer:
        tokenizer: TrainedTokenizer = self.given["tokenizer"]
        return tokenizer

    @property
    def prepared(self) -> Mapping[str, object]:
        return {"text": self.given.get("text")}

    @property
    def max_frames(self) -> int:
        return self.net.max_groups * self.unit_frames

    def generate(self, request: GenerationRequest) -> list[NDArray[np.float32]]:
        """Lengths that are no whole groups are made of one group more, and cut."""
        text, device, sampling = request.text("this model"), device_of(self.net), request.sampling
        frames, unit = request.frames, self.unit_frames
        codes = draw_tokens(
            self.net,
            text.features.to(device),
            text.mask.to(device),
            None if frames is None else torch.tensor([-(-count // unit) for count in frames]),
            request.seeds,
            Drawing(sampling.temperature, sampling.top_k or None, sampling.top_p),
        )
        motions = self.tokenizer.decode(codes.codes, codes.groups.tolist())
        if frames is None:
            return motions
        return [motion[:count] for motion, count in zip(motions, frames, strict=True)]
