"""`DmdStream`: a `Dmd`'s motion of tokens that arrive group by group, in bounded memory [ours].

A whole motion is denoised at once, its windows agreeing at every step (`sampling.py`): the last token
can change the first frame. Here each window is denoised alone as soon as its tokens are known, and the frames
that it shares with the one before fade from one to the other. The noise of a frame is the same in every
window, and so are its tokens, so both say nearly the same. The last window ends with the motion.

The frames depend on tokens and seed alone, not on the pieces in which they came.

Legend: G groups, T frames, D features.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from motionloom.models.diffusion.dmd import Dmd
from motionloom.models.diffusion.sampling import decode_window
from motionloom.models.diffusion.schedule import Sampler
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.models.tokenizer.streaming import ArrivingTokens


class DmdStream(ArrivingTokens):
    """Decodes one motion's tokens as they come, to the coordinates of training.

    Args:
        per_group: Tokens of each stream in a group.
        window: Frames denoised at once, a multiple of 4.
        overlap: Frames that neighbouring windows share, a multiple of 4 and at most half a window.
    """

    def __init__(
        self,
        net: Dmd,
        per_group: Mapping[str, int],
        *,
        seed: int,
        sampler: Sampler,
        steps: int,
        window: int,
        overlap: int,
    ) -> None:
        super().__init__(per_group)
        self.net, self.seed = net.eval(), seed
        self.sampler, self.steps = sampler, steps
        self.window, self.overlap = window, min(overlap, window // 2 // GROUP_FRAMES * GROUP_FRAMES)
        self._given = 0
        """Frames given."""
        self._tail: Tensor | None = None
        """The previous window's prediction of the frames that follow [overlap, D]."""

    def push(self, codes: Mapping[str, Tensor]) -> Tensor | None:
        """More tokens, per stream int64 [1, G * per_group] -> the frames [T, D] that are final now; None =
        none yet.
        """
        self._add(codes)
        out = []
        # Not the window that ends with what is known: where the motion ends there, it is the last one.
        while self._given + self.window < self._known * GROUP_FRAMES:
            made = self._blended(self._decode(self._given, self.window))
            keep = self.window - self.overlap
            out.append(made[:keep])
            self._tail, self._given = made[keep:], self._given + keep
            # The last window may begin a window before the end.
            self._forget(max(0, (self._given - self.window) // GROUP_FRAMES))
        return torch.cat(out) if out else None

    def finish(self) -> Tensor | None:
        """The frames [T, D] up to the end; None where all were given."""
        end = self._known * GROUP_FRAMES
        if end == self._given:
            return None
        start = min(self._given, max(0, end - self.window))
        out = self._blended(self._decode(start, end - start)[self._given - start :])
        self._given, self._tail = end, None
        return out

    def _decode(self, start: int, frames: int) -> Tensor:
        first = start // GROUP_FRAMES - self._first
        cut = {
            name: self._codes[name][:, first * per : (first + frames // GROUP_FRAMES) * per]
            for name, per in self.per_group.items()
        }
        noise = np.stack([self._noise(frame) for frame in range(start, start + frames)])
        return decode_window(
            self.net,
            cut,
            torch.from_numpy(noise).float(),
            seed=int(np.random.SeedSequence([self.seed, start]).generate_state(1, np.uint64)[0] >> 1),
            sampler=self.sampler,
            steps=self.steps,
        )

    def _noise(self, frame: int) -> np.ndarray:
        """Return the noise that a frame is denoised from [D]."""
        stream = np.random.Philox(key=self.seed + (2 << 64), counter=[0, 0, 0, frame])
        return np.random.Generator(stream).standard_normal(self.net.motion_dim)

    def _blended(self, made: Tensor) -> Tensor:
        """The frames from `_given` on, faded in over the tail of the window before."""
        if self._tail is None:
            return made
        count = min(len(self._tail), len(made))
        rise = (torch.arange(count, device=made.device, dtype=made.dtype) + 1)[:, None] / (
            len(self._tail) + 1
        )
        both = rise * made[:count] + (1 - rise) * self._tail[:count]
        return torch.cat([both, made[count:]])
