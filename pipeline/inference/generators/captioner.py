"""Sentences about motions by a captioner of motion tokens (TM2T section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.schema import PRESENT_ALL, UserError
from motionloom.models.baselines.tm2t.beam import likeliest
from motionloom.models.baselines.tm2t.network import Captioner
from motionloom.models.baselines.tm2t.vocabulary import Vocabulary
from motionloom.models.gpt.tokens import interleave
from motionloom.pipeline.contract.captioning import Sentence
from motionloom.pipeline.store.networks import TrainedTokenizer, device_of
from motionloom.pipeline.store.tokens import PresentTokens, present_table

_AT_ONCE = 32
"""Motions that are read together."""


@dataclass(frozen=True)
class TokenCaptioner:
    """TM2T's captioner: motion to tokens, tokens to words."""

    net: Captioner
    tokenizer: TrainedTokenizer
    vocabulary: Vocabulary
    beam: int = 4
    """Unfinished sentences that the search keeps, at least."""

    @property
    def layout(self) -> MotionLayout:
        return self.tokenizer.layout

    @property
    def part(self) -> Part:
        return self.tokenizer.net.part

    @property
    def min_frames(self) -> int:
        return self.tokenizer.net.group_frames

    @property
    def max_frames(self) -> int:
        return self.net.max_groups * self.tokenizer.net.group_frames

    def reads(self, present: int) -> bool:
        return bool(present_table(self.tokenizer.net, self.layout).usable[present])

    def caption(
        self, motions: Sequence[NDArray[np.float32]], count: int, present: Sequence[int] | None = None
    ) -> list[list[Sentence]]:
        """As `MotionCaptioner` says; batches hold motions of about one length."""
        bits = [PRESENT_ALL] * len(motions) if present is None else list(present)
        order = np.argsort([len(motion) for motion in motions], kind="stable").tolist()
        out: dict[int, list[Sentence]] = {}
        for start in range(0, len(order), _AT_ONCE):
            rows = order[start : start + _AT_ONCE]
            made = self._batch([motions[row] for row in rows], count, [bits[row] for row in rows])
            out.update(zip(rows, made, strict=True))
        return [out[row] for row in range(len(motions))]

    @torch.no_grad()
    def _batch(
        self, motions: Sequence[NDArray[np.float32]], count: int, bits: Sequence[int]
    ) -> list[list[Sentence]]:
        net, device = self.net, device_of(self.net)
        codes = self.tokenizer.encode([motion[: self.max_frames] for motion in motions], bits)
        closed = torch.tensor([len(motion) <= self.max_frames for motion in motions], device=device)
        tokens = interleave(codes.codes, net.pattern, ends=net.num_codes, groups=codes.groups, closed=closed)
        if not all(map(self.reads, bits)):
            raise UserError(
                "a motion lacks hands or a face, and this captioner's tokens say them and the body in one; "
                "give motions that have them, or a captioner on tokens of the body alone"
            )
        table = present_table(self.tokenizer.net, self.layout)
        present = PresentTokens(torch.tensor(bits), table.streams, table.columns)
        near = tokens._replace(tokens=tokens.tokens.cpu(), kinds=tokens.kinds.cpu())
        known = present.known(list(range(len(motions))), near, net.ends.cpu()).to(device)
        embedded = net.embedded(tokens.tokens, tokens.kinds, known)
        found = likeliest(net, net.begin(embedded, tokens.tokens >= 0), count, self.beam)
        return [
            [Sentence(self.vocabulary.decode(one.words), one.log_probability) for one in sentences]
            for sentences in found
        ]
