"""Motion that is partly given: diffusion under a mask, pulled towards places and pins.

At every denoising step the predicted clean motion is replaced by the given one where that is known (MDM's
editing), led and smoothed so that both join [ours], and pulled by the gradient of what it
misses by: the root's known places and headings, and pinned joints, recovered in metres (`recovery.py`).
Networks with `observed` columns are also shown all that is known but the pins.

Motions longer than the training's are made in overlapping windows that agree at every step, and stretches of
other words are windows of their own: a frame is the mean of the predictions for it, weighed by how much it
belongs to window and words.

Legend: n motions of one task, T frames, D features, S stretches of words, K rows (a window and its words),
W frames of a window, M pins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from torch import Tensor
from torch.func import jvp

from motionloom.models.diffusion.network import MotionDiffusion
from motionloom.models.diffusion.observed import Places, observed_columns
from motionloom.models.diffusion.recovery import Recovery, turned_back
from motionloom.models.diffusion.sampling import blend_weights, window_starts
from motionloom.models.diffusion.schedule import Sampler
from motionloom.models.gpt.frozen import evaluating

HEADING_METRES = 0.5
"""What a radian of heading counts as: how far it moves a hand."""


@dataclass(frozen=True)
class Pins:
    """Joints whose place is given, in metres, in the frame of `Places`."""

    frames: Tensor
    """int64 [M]."""
    joints: Tensor
    """int64 [M]."""
    positions: Tensor
    """[M, 3]."""


@dataclass(frozen=True)
class Given:
    """What is known of a motion."""

    motion: Tensor
    """[T, D], normalised; anything where nothing is known, unless `likeness` is asked for."""
    known: Tensor
    """bool [T, D]."""
    places: Places | None = None
    """One row; None where the columns hold no root."""
    pins: Pins | None = None


@dataclass(frozen=True)
class Worded:
    """Words and the frames that they are about."""

    text: Tensor
    """[E]; zeros without words."""
    conditioned: bool
    share: Tensor
    """[T]; the shares of all stretches sum to 1 in each frame."""


class Filling:
    """Fills in what is not given.

    Args:
        recovery: None where the columns hold no root; then nothing is pulled.
        window: Frames denoised at once: what the network was trained on.
        overlap: Frames that neighbouring windows share.
        guidance: Of the words, classifier-free; 1 is off.
        strength: Gradient steps towards places and pins in each denoising step; a fraction is a shorter one.
        likeness: Of free values to `given.motion`, 0 to 1: denoising begins from it, noised so far.
    """

    def __init__(
        self,
        net: MotionDiffusion,
        given: Given,
        words: Sequence[Worded],
        recovery: Recovery | None,
        *,
        window: int,
        overlap: int,
        guidance: float = 1.0,
        strength: float = 1.0,
        likeness: float = 0.0,
    ) -> None:
        self.net, self.given, self.recovery = net, given, recovery
        self.guidance, self.strength, self.likeness = guidance, strength, likeness
        self.noiser = net.config.schedule.noiser()
        frames = len(given.motion)
        self.size = min(window, frames)
        overlap = min(overlap, self.size // 2)
        starts = window_starts(frames, self.size, overlap)
        blend = blend_weights(starts, self.size, overlap, frames).to(given.motion)
        free = ~given.known.all(1)
        rows = [
            (start, said, blend[number] * said.share)
            for (number, start), said in product(enumerate(starts), words)
        ]
        # What lies in a window without anything to fill in, or with no word of its words, needs no network.
        rows = [row for row in rows if (row[2] * free).any()]
        self.starts = [start for start, _, _ in rows]
        shares = torch.stack([share for _, _, share in rows])
        self.shares = shares / shares.sum(0).clamp(min=1e-9)
        self.text = torch.stack([said.text for _, said, _ in rows])
        self.conditioned = torch.tensor([said.conditioned for _, said, _ in rows], device=self.text.device)
        self.seen = torch.stack([self._seen(start) for start in self.starts])
        self._joints = self._joints_of()

    def __call__(self, seeds: Sequence[int], sampler: Sampler, steps: int) -> Tensor:
        """Motions [n, T, D], normalised, one for each seed; what is known in them is the given to the bit."""
        given, schedule = self.given, self.net.config.schedule
        noise = [torch.Generator().manual_seed(seed) for seed in seeds]
        x = torch.stack([torch.randn(given.motion.shape, generator=one) for one in noise]).to(given.motion)
        skip = min(round(self.likeness * steps), steps - 1)
        if skip:
            begin = schedule.sampler(sampler, steps).timesteps[skip].expand(len(x)).to(x.device)
            x = self.noiser.add_noise(given.motion.expand_as(x), x, begin).to(x)
        with evaluating(self.net):
            made = schedule.denoise(self._predict, x, noise, sampler, steps, skip=skip)
        return self._replaced(self._joined(made))

    def _seen(self, start: int) -> Tensor:
        """What the network is shown of a window [W, 2 D + 6]."""
        inside = slice(start, start + self.size)
        places = None if self.given.places is None else _from_window(self.given.places, inside)
        return observed_columns(self.given.motion[None, inside], self.given.known[None, inside], places)[0]

    @torch.no_grad()
    def _predict(self, x: Tensor, step: Tensor) -> Tensor:
        """The network's prediction for motions x [n, T, D], after what is known and asked of it."""
        found = self._blended(x, step)
        if self.net.config.schedule.predicts == "sample":
            return self._pulled(self._joined(found))
        kept = self.noiser.alphas_cumprod[int(step)].to(x)
        found = (x - (1 - kept).sqrt() * found) / kept.sqrt()
        clean = self._pulled(self._joined(found))
        return (x - kept.sqrt() * clean) / (1 - kept).sqrt()

    def _blended(self, x: Tensor, step: Tensor) -> Tensor:
        """The means of all rows' predictions [n, T, D]."""
        count, guided = len(x), self.guidance != 1.0 and bool(self.conditioned.any())
        windows = torch.stack([x[:, start : start + self.size] for start in self.starts], dim=1)
        rows = windows.flatten(0, 1)

        def repeated(values: Tensor) -> Tensor:
            return values.repeat(count, *(1,) * (values.ndim - 1))

        mask = torch.ones(rows.shape[:2], dtype=torch.bool, device=x.device)
        at = step.to(x.device).expand(len(rows))
        inputs = repeated(self.text), mask, repeated(self.conditioned)
        found = self.net(rows, at, *inputs, repeated(self.seen))
        if guided:
            without = self.net(rows, at, inputs[0], mask, torch.zeros_like(inputs[2]), repeated(self.seen))
            found = without + self.guidance * (found - without)
        found = found.view(count, len(self.starts), *found.shape[1:])
        out = torch.zeros_like(x)
        for number, start in enumerate(self.starts):
            inside = slice(start, start + self.size)
            out[:, inside] += self.shares[number, inside, None] * found[:, number]
        return out

    def _replaced(self, motion: Tensor) -> Tensor:
        return torch.where(self.given.known, self.given.motion, motion)

    def _misses(self, motion: Tensor) -> Tensor:
        """By how much motions [n, T, D] miss places, headings and pins, in metres [n, ...]."""
        assert self.recovery is not None and self.given.places is not None
        places, pins = self.given.places, self.given.pins
        anchor = places.anchor.expand(len(motion))
        heading, place = self.recovery.way(motion, anchor)
        stood, turned = places.place_known[0], places.heading_known[0]
        misses = [
            (place - places.place)[:, stood].flatten(1),
            HEADING_METRES * (heading - places.heading)[:, turned],
        ]
        if pins is not None:
            joints = self.recovery.world(motion, anchor)[:, pins.frames, pins.joints]
            misses.append((joints - pins.positions).flatten(1))
        return torch.cat(misses, dim=1)

    def _pulled(self, motion: Tensor) -> Tensor:
        """Free values moved against the gradient of the squared misses, each step as far as helps most."""
        if self.recovery is None or self.given.places is None:
            return motion
        left = self.strength
        while left > 0:
            with torch.enable_grad():
                at = motion.detach().requires_grad_()
                misses = self._misses(at)
                [slope] = torch.autograd.grad(misses.square().sum() / 2, at)
            slope = slope.masked_fill(self.given.known, 0.0)
            change: Tensor = jvp(self._misses, (motion,), (slope,))[1]
            size = slope.square().sum((1, 2)) / change.square().sum(1).clamp(min=1e-12)
            motion = motion - min(left, 1.0) * size[:, None, None] * slope
            left -= 1
        return motion

    def _joined(self, motion: Tensor) -> Tensor:
        """Motions [n, T, D] with what is known in its place, and the free values led to it.

        Networks do not quite begin where the kept part ends, and small ones tremble. By how much they miss
        what is known is taken from the free values too, less and less away from it and with as little bending
        as that needs; then each column is the nearest to theirs whose second differences are small.
        """
        out = self._replaced(motion)
        missed = out - motion
        for columns, leading, smoother in self._joints:
            led = out[..., columns] + torch.einsum("ts,nsd->ntd", leading, missed[..., columns])
            out[..., columns] = torch.einsum("ts,nsd->ntd", smoother, led)
        return out

    def _joints_of(self) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Columns that are known in the same frames; what leads them there, and what smooths them: [T, T]."""
        known, like = self.given.known, self.given.motion
        one = torch.eye(len(known), dtype=torch.float64)
        bends = one.diff(n=2, dim=0)
        bending = bends.T @ bends
        patterns, of = np.unique(known.T.cpu().numpy(), axis=0, return_inverse=True)
        out = []
        for number, pattern in enumerate(patterns):
            free = torch.from_numpy(~pattern)[:, None]
            leading = torch.linalg.inv(torch.where(free, bending + _LETTING_GO * one, one)) * free
            smoother = torch.linalg.inv(one + _STIFFNESS * bending * free)
            columns = torch.from_numpy(np.flatnonzero(of.reshape(-1) == number))
            out.append((columns.to(like.device), leading.to(like), smoother.to(like)))
        return out


_STIFFNESS = 1.0
"""Of what is made: 1 halves what goes to and fro 3.3 times a second at 20 frames a second."""
_LETTING_GO = 3.0**-4
"""Of what is led: it follows for about three frames."""


def _from_window(places: Places, inside: slice) -> Places:
    """The places of a window, seen from its first known one."""
    heading, place = places.heading[:, inside], places.place[:, inside]
    turned, stood = places.heading_known[:, inside], places.place_known[:, inside]
    both = turned & stood
    known = both if bool(both.any()) else stood
    first = known.byte().argmax(1)
    angle, origin = heading[0, first], place[0, first]
    if not bool(both.any()) and bool(stood.any()):
        angle = _tangent(place[0], stood[0])
        turned = turned.clone()
        turned[0, first] = True
        heading = heading.clone()
        heading[0, first] = angle
    away = place - origin
    seen = turned_back(away, angle)
    return Places(first, heading - angle, seen, turned, stood)


def _tangent(place: Tensor, known: Tensor) -> Tensor:
    """Heading [1] of the way from the first known place to the next that is half a metre off, or the last."""
    points = place[known]
    away = points - points[0]
    far = away.norm(dim=-1) > 0.5
    towards = away[far.byte().argmax() if bool(far.any()) else -1]
    return torch.atan2(towards[1], towards[0])[None]
