"""Motion editing: diffusion under a mask, with a gradient towards places.

At every denoising step the predicted clean motion is replaced by the known one where there is one (MDM's
editing). The prediction is fitted to the known frames and smoothed [ours], and a gradient step reduces its
distance to the root's known places and headings, in metres (`observed.py`) [ours]. The
in-betweener also observes all that is known.

Motions longer than the training's are made in overlapping windows that agree at every step: a frame is the
mean of the predictions for it, weighed by how much it belongs to each window.

Legend: n motions of one task, T frames, D features, K windows of W frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.func import jvp

from motionloom.datasets.motion.canonical import runs
from motionloom.models.diffusion.sampling import blend_weights, window_starts
from motionloom.models.diffusion.schedule import Sampler
from motionloom.models.layers.frozen import evaluating
from motionloom.pipeline.editing.inbetween.network import InBetweener
from motionloom.pipeline.editing.inbetween.observed import Places, Recovery, observed_columns, turned_back

HEADING_METRES = 0.5
"""Metres that a radian of heading counts as: how far it moves a hand [ours]."""


@dataclass(frozen=True)
class KnownMotion:
    """A motion of which a part is known."""

    motion: Tensor
    """[T, D], normalised; any values where nothing is known."""
    mask: Tensor
    """bool [T, D]."""
    places: Places
    """One row."""


class Filling:
    """Fills in the free values of a motion.

    Args:
        text: Sentence embedding [E] of the caption; None without one.
        window: Frames denoised at once: those that the network was trained on.
        overlap: Frames that neighbouring windows share.
        guidance: Classifier-free guidance of the caption; 1 is off.
    """

    def __init__(
        self,
        net: InBetweener,
        known: KnownMotion,
        text: Tensor | None,
        recovery: Recovery,
        *,
        window: int,
        overlap: int,
        guidance: float = 1.0,
    ) -> None:
        self.net = net
        self.known = known
        self.recovery = recovery
        self.guidance = guidance
        frames = len(known.motion)
        self.size = min(window, frames)
        overlap = min(overlap, self.size // 2)
        starts = window_starts(frames, self.size, overlap)
        blend = blend_weights(starts, self.size, overlap, frames).to(known.motion)
        free = ~known.mask.all(1)
        # Windows without free values need no network.
        rows = [number for number in range(len(starts)) if (blend[number] * free).any()]
        self.starts = [starts[number] for number in rows]
        self.shares = blend[rows] / blend[rows].sum(0).clamp(min=1e-9)
        self.text = known.motion.new_zeros(net.text_dim) if text is None else text
        self.conditioned = text is not None
        self.observed = torch.stack([self._observed(start) for start in self.starts])
        self._boundaries = self._boundary_filters()

    def __call__(self, seeds: Sequence[int], sampler: Sampler, steps: int) -> Tensor:
        """Return motions [n, T, D], normalised, one for each seed; known values are kept to the bit."""
        known = self.known
        schedule = self.net.config.schedule
        noise = [torch.Generator().manual_seed(seed) for seed in seeds]
        x = torch.stack([torch.randn(known.motion.shape, generator=one) for one in noise]).to(known.motion)
        with evaluating(self.net):
            filled = schedule.denoise(self._predict, x, noise, sampler, steps)
        return self._with_known(self._smoothed(filled))

    def _observed(self, start: int) -> Tensor:
        """Return the observed columns of a window [W, 2 D + 6]."""
        inside = slice(start, start + self.size)
        places = _places_of_window(self.known.places, inside)
        return observed_columns(self.known.motion[None, inside], self.known.mask[None, inside], places)[0]

    @torch.no_grad()
    def _predict(self, x: Tensor, step: Tensor) -> Tensor:
        """Return the predicted clean motions of x [n, T, D], corrected by what is known."""
        return self._gradient_step(self._smoothed(self._blended(x, step)))

    def _blended(self, x: Tensor, step: Tensor) -> Tensor:
        """Return the means of all windows' predictions [n, T, D]."""
        count = len(x)
        windows = torch.stack([x[:, start : start + self.size] for start in self.starts], dim=1)
        rows = windows.flatten(0, 1)
        mask = torch.ones(rows.shape[:2], dtype=torch.bool, device=x.device)
        at = step.to(x.device).expand(len(rows))
        text = self.text.expand(len(rows), -1)
        observed = self.observed.repeat(count, 1, 1)
        conditioned = mask.new_full((len(rows),), self.conditioned)
        found = self.net(rows, at, text, mask, conditioned, observed)
        if self.guidance != 1.0 and self.conditioned:
            without = self.net(rows, at, text, mask, torch.zeros_like(conditioned), observed)
            found = without + self.guidance * (found - without)
        found = found.view(count, len(self.starts), *found.shape[1:])
        out = torch.zeros_like(x)
        for number, start in enumerate(self.starts):
            inside = slice(start, start + self.size)
            out[:, inside] += self.shares[number, inside, None] * found[:, number]
        return out

    def _with_known(self, motion: Tensor) -> Tensor:
        return torch.where(self.known.mask, self.known.motion, motion)

    def _errors(self, motion: Tensor) -> Tensor:
        """Return the errors of motions [n, T, D] in places and headings, in metres [n, ...]."""
        places = self.known.places
        heading, place = self.recovery.way(motion, places.anchor.expand(len(motion)))
        away = (place - places.place)[:, places.place_known[0]].flatten(1)
        turned = (heading - places.heading)[:, places.heading_known[0]]
        return torch.cat([away, HEADING_METRES * turned], dim=1)

    def _gradient_step(self, motion: Tensor) -> Tensor:
        """Return motions moved in their free values against the gradient of the squared errors."""
        with torch.enable_grad():
            at = motion.detach().requires_grad_()
            [slope] = torch.autograd.grad(self._errors(at).square().sum() / 2, at)
        slope = slope.masked_fill(self.known.mask, 0.0)
        # The length of the step minimises the errors as they change linearly along the gradient.
        change: Tensor = jvp(self._errors, (motion,), (slope,))[1]
        size = slope.square().sum((1, 2)) / change.square().sum(1).clamp(min=1e-12)
        return motion - size[:, None, None] * slope

    def _smoothed(self, motion: Tensor) -> Tensor:
        """Return motions [n, T, D] with known values in place and free values fitted to them.

        Networks do not quite begin where the known part ends, least of all with people unlike those of their
        training, and small ones tremble. In gaps between known frames the prediction is therefore `_carried`;
        elsewhere the error at known values is subtracted from the free ones too, less and less away from the
        boundary and with as little bending as that needs. Then each column becomes the nearest with small
        second differences.
        """
        out = self._with_known(motion)
        error = out - motion
        for columns, legs, gaps, correction, smoother in self._boundaries:
            known = out[..., columns]
            corrected = known + torch.einsum("ts,nsd->ntd", correction, error[..., columns])
            for gap in gaps:
                corrected[:, gap] = _carried(motion[:, gap, columns], known, gap, legs)
            out[..., columns] = torch.einsum("ts,nsd->ntd", smoother, corrected)
        return out

    def _boundary_filters(self) -> list[tuple[Tensor, Tensor, list[slice], Tensor, Tensor]]:
        """Return, for columns that are known in the same frames: the columns, which of them are of legs, the
        gaps in which they are carried, and the matrices [T, T] that spread the error at known frames over
        other free ones and that smooth the result.
        """
        known = self.known.mask
        like = self.known.motion
        one = torch.eye(len(known), dtype=torch.float64)
        bends = one.diff(n=2, dim=0)
        bending = bends.T @ bends
        # Columns share a mask by parts of the figure, so there are few matrices to invert.
        patterns, of = np.unique(known.T.cpu().numpy(), axis=0, return_inverse=True)
        out = []
        for number, pattern in enumerate(patterns):
            free = torch.from_numpy(~pattern)[:, None]
            correction = torch.linalg.inv(torch.where(free, bending + _DECAY * one, one)) * free
            smoother = torch.linalg.inv(one + _STIFFNESS * bending * free)
            columns = np.flatnonzero(of.reshape(-1) == number)
            # Two known frames on either side tell how fast the figure enters and leaves. Steps of the root
            # follow its places instead, by the gradient.
            gaps = [
                slice(start, stop)
                for start, stop in runs(~pattern)
                if pattern[max(start - 2, 0) : start].sum() == pattern[stop : stop + 2].sum() == 2
                and not self.recovery.steps[columns].all()
            ]
            own = torch.from_numpy(columns).to(like.device), self.recovery.legs[columns].to(like.device)
            out.append((*own, gaps, correction.to(like), smoother.to(like)))
        return out


def _carried(predicted: Tensor, known: Tensor, gap: slice, legs: Tensor) -> Tensor:
    """Return predicted motions [n, G, D] of a gap in known ones [n, T, D], moved to meet these [ours].

    Shifts that change evenly along the gap bring its first and last frame to where the known ones lead. Of
    what the prediction then adds to the straight line between the known frames the less is taken the larger
    the shifts had to be: a Wiener filter, whose noise they are. So gaps of people unlike those of training
    are bridged rather by straight lines. Of columns of `legs`, bool [D], all is taken: half a step glides.
    """
    before = known[:, gap.start - 1, None]
    after = known[:, gap.stop, None]
    first = 2 * before - known[:, gap.start - 2, None]
    last = 2 * after - known[:, gap.stop + 1, None]
    share = torch.linspace(0, 1, predicted.shape[1] + 2).to(known)[1:-1, None]
    shift = torch.lerp(first - predicted[:, :1], last - predicted[:, -1:], share)
    line = torch.lerp(before, after, share)
    added = predicted + shift - line
    signal = added.square().mean(1, keepdim=True)
    noise = shift.square().mean(1, keepdim=True)
    return line + added * torch.where(legs, 1.0, signal / (signal + noise).clamp(min=1e-12))


_STIFFNESS = 1.0
"""Weight of second differences in smoothing [ours]: 1 halves oscillations of 3.3 Hz at 20 frames a second."""
_DECAY = 3.0**-4
"""Weight of a correction's size beside its bending [ours]: it lasts for about three frames."""


def _places_of_window(places: Places, inside: slice) -> Places:
    """Return the places of a window, relative to its first known one."""
    heading = places.heading[:, inside]
    place = places.place[:, inside]
    heading_known = places.heading_known[:, inside]
    place_known = places.place_known[:, inside]
    both = heading_known & place_known
    first = (both if bool(both.any()) else place_known).byte().argmax(1)
    heading_known = heading_known.clone()
    heading_known[0, first] |= place_known[0, first]
    angle = heading[0, first]
    origin = place[0, first]
    relative = turned_back(place - origin, angle)
    return Places(first, heading - angle, relative, heading_known, place_known)
