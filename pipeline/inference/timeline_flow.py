"""`TimelineFlow`: tokens along a time line as they come, for streams.

The windows, their seeds and what they see are those of `TokenTimeline.tokens`; of what came before only the
last groups are kept. So a script gives the same tokens, and memory does not grow.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from motionloom.datasets.conditions import MODALITIES, Conditions
from motionloom.models.gpt.tokens import Codes
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.models.utt.continuing import join
from motionloom.models.utt.sampling import draw_z
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.timeline import TokenTimeline, cut, window_seeds


class TimelineFlow:
    """One motion's tokens, window after window.

    Args:
        timeline: What makes a window.
        seed: Of the motion.
        sampling: How tokens are drawn.
        hop: Groups that are drawn at a time while the length of a stretch is not known.
    """

    def __init__(self, timeline: TokenTimeline, seed: int, sampling: SamplingConfig, hop: int) -> None:
        self._line, self._seed, self._sampling, self._hop = timeline, seed, sampling, hop
        utt = timeline.net.utt
        self._device = next(timeline.net.parameters()).device
        empty = torch.zeros(1, 0, dtype=torch.int64, device=self._device)
        self._before = Codes(dict.fromkeys(utt.names, empty), self._count(0))
        drawn = timeline.inject_z and utt.config.z_dim
        self._z = draw_z([seed], utt.config.z_dim).to(self._device) if drawn else None
        self._conditions: Conditions = {}
        self._number, self._turn, self._done = -1, 0, 0
        """Which stretch this is, and the windows and groups of it that there are."""

    def condition(self, conditions: Conditions) -> None:
        """A new stretch."""
        self._conditions = self._line.normalised(conditions)
        self._number, self._turn, self._done = self._number + 1, 0, 0

    @torch.no_grad()
    def draw(self, left: int | None) -> Mapping[str, Tensor]:
        """One window."""
        line = self._line
        seen = int(self._before.groups[0])
        new = min(self._hop if left is None else left, line.window_groups - seen)
        first, frames = self._count((self._done - seen) * GROUP_FRAMES), self._count((seen + new) * GROUP_FRAMES)
        inside = {
            name: cut(condition, first, frames) if MODALITIES[name].timed else condition
            for name, condition in self._conditions.items()
        }
        seeds = window_seeds([self._seed], self._number, self._turn)
        more = line.window(inside, self._before, self._z, self._count(new), seeds, self._sampling)
        self._turn, self._done = self._turn + 1, self._done + new
        self._before = self._last(join(self._before, more, line.net.utt.pattern))
        return more.codes

    def _last(self, codes: Codes) -> Codes:
        """What the next window sees."""
        kept = min(int(codes.groups[0]), self._line.context)
        pattern = self._line.net.utt.pattern
        return Codes(
            {name: v[:, v.shape[1] - kept * pattern.count(name) :] for name, v in codes.codes.items()},
            self._count(kept),
        )

    def _count(self, groups: int) -> Tensor:
        return torch.tensor([groups], device=self._device)
