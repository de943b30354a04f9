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
        hop: Groups that are drawn at a time; also a window's length while that of its stretch is not known.
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
        self._inside: Conditions = {}
        self._open = self._drawn = 0
        """Groups that this window has yet to come, and those that it has; its conditions are `_inside`."""

    def condition(self, conditions: Conditions) -> None:
        """A new stretch."""
        self._conditions = self._line.normalised(conditions)
        self._number, self._turn, self._done, self._open = self._number + 1, -1, 0, 0

    @torch.no_grad()
    def draw(self, left: int | None) -> Mapping[str, Tensor]:
        """A piece of a window, drawn as the whole window would be."""
        if not self._open:
            self._begin(left)
        new = min(self._hop, self._open)
        seeds = window_seeds([self._seed], self._number, self._turn)
        more = self._line.window(
            self._inside, self._before, self._z, self._count(new), seeds, self._sampling, self._drawn
        )
        self._before = join(self._before, more, self._line.net.utt.pattern)
        self._open, self._drawn, self._done = self._open - new, self._drawn + new, self._done + new
        return more.codes

    def _begin(self, left: int | None) -> None:
        """The next window, and what of the conditions lies in it."""
        self._before, self._turn, self._drawn = self._last(self._before), self._turn + 1, 0
        seen = int(self._before.groups[0])
        self._open = min(self._hop if left is None else left, self._line.window_groups - seen)
        first, frames = (self._done - seen) * GROUP_FRAMES, (seen + self._open) * GROUP_FRAMES
        self._inside = {
            name: cut(condition, self._count(first), self._count(frames))
            if MODALITIES[name].timed
            else condition
            for name, condition in self._conditions.items()
        }

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
