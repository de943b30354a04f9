"""Motions from trained denoisers, by diffusers' samplers: of a text, and of tokens in overlapping windows.

A window of frames carries its own tokens, so the motion of tokens of any length is cut into windows of the
size that the DMD was trained on. At every denoising step each window's noise is predicted, overlapping
predictions are averaged with weights that rise and fall linearly across the overlap, and one step is taken on
the whole motion [ours]. Averaging noise is averaging x0, which is linear in it at a given x_t. Since all
windows are denoised together from one noise, no seam is left; a motion that fits into one window is denoised
as it is.

Legend: n motions, T frames, D features, K windows, W frames of a window.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from motionloom.datasets.base.errors import UserError
from motionloom.models.diffusion.dmd import Dmd
from motionloom.models.diffusion.network import TextDenoiser
from motionloom.models.diffusion.schedule import Sampler, by_length
from motionloom.models.gpt.tokens import Codes
from motionloom.models.layers.frozen import evaluating
from motionloom.models.layers.transformer import length_mask
from motionloom.models.tokenizer.base import GROUP_FRAMES


def sample_motions(
    net: TextDenoiser,
    text: Tensor,
    frames: Sequence[int],
    *,
    seeds: Sequence[int],
    sampler: Sampler = "ddpm",
    steps: int = 50,
    guidance: float = 1.0,
) -> list[Tensor]:
    """Normalised motions [T, D] for text vectors [n, E], one length and one seed each (`sample_guided`)."""

    def predict(noisy: Tensor, step: Tensor, text: Tensor, conditioned: Tensor) -> Tensor:
        mask = torch.ones(noisy.shape[:2], dtype=torch.bool, device=noisy.device)
        found: Tensor = net(noisy, step, text, mask, conditioned)
        return found

    how = {"seeds": seeds, "sampler": sampler, "steps": steps, "guidance": guidance}
    return sample_guided(net, predict, text, frames, net.motion_dim, **how)  # type: ignore[arg-type]


@torch.no_grad()
def sample_guided(
    net: nn.Module,
    predict: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor],
    text: Tensor,
    frames: Sequence[int],
    dim: int,
    *,
    seeds: Sequence[int],
    sampler: Sampler,
    steps: int,
    guidance: float,
) -> list[Tensor]:
    """Sequences [T, dim] for text vectors [n, E], one length and one seed each (`by_length`).

    Args:
        net: A denoiser, whose config has `condition_dropout` and `schedule`; is left in evaluation mode.
        predict: Its output [B, T, dim] for noisy sequences, time steps [B], text [B, E] and conditioned [B].
        guidance: 1 is off; else both passes go through one forward.

    `UserError` for guidance of a model that never trained without text, and for more `steps` than the
    training's.
    """
    config: Any = net.config
    if guidance != 1 and config.condition_dropout == 0:
        raise UserError(
            "guidance needs a diffusion model trained with condition_dropout > 0; set cfg_scale, of a face "
            "face_cfg_scale, to 1"
        )
    net.eval()
    guided = guidance != 1.0

    def denoised(rows: list[int], x: Tensor, noise: list[torch.Generator]) -> Tensor:
        count = len(rows)
        # Rows with their text first, then the same rows without, in one forward pass.
        both = text[rows].repeat(1 + guided, 1)
        conditioned = torch.arange(len(both), device=text.device) < count

        def step(given: Tensor, at: Tensor) -> Tensor:
            steps = at.to(text.device).expand(len(both))
            found = predict(given.repeat(1 + guided, 1, 1), steps, both, conditioned)
            return found[count:] + guidance * (found[:count] - found[count:]) if guided else found

        denoised: Tensor = config.schedule.denoise(step, x, noise, sampler, steps)
        return denoised

    return by_length(frames, seeds, dim, text.device, denoised)


@torch.no_grad()
def decode_motions(
    net: Dmd,
    codes: Codes,
    *,
    seeds: Sequence[int],
    sampler: Sampler = "ddpm",
    steps: int = 50,
    window: int = 160,
    overlap: int = 32,
    hidden: Tensor | None = None,
) -> list[Tensor]:
    """Motions [T, D] of n token sequences, in the coordinates of training, one seed each (UDE section 3.4).

    Args:
        net: The denoiser; runs in evaluation mode and is left as it was.
        codes: Tokens, n rows.
        seeds: One per row; repeat a row with other seeds for more motions of one token sequence.
        steps: Denoising steps, at most those of the training.
        window: Frames denoised at once, a multiple of 4: what the network was trained on.
        overlap: Frames that neighbouring windows share, a multiple of 4 below `window`.
        hidden: Bool [n, G], groups that are filled in without their tokens, if the training had `hide`.
    """
    if len(seeds) != len(codes.groups):
        raise UserError(
            f"{len(seeds)} seeds and {len(codes.groups)} token sequences; each motion needs its own"
        )
    if hidden is not None and not net.config.hide:
        raise UserError(
            "this DMD was trained with every token in sight and cannot fill in for hidden ones; train it "
            "with net.hide above 0"
        )
    if window % GROUP_FRAMES or overlap % GROUP_FRAMES or not 0 <= overlap < window:
        raise UserError(
            f"window {window} and overlap {overlap} must be multiples of {GROUP_FRAMES}, the overlap smaller"
        )

    def denoised(rows: list[int], x: Tensor, noise: list[torch.Generator]) -> Tensor:
        mine = {name: values[rows] for name, values in codes.codes.items()}
        unread = None if hidden is None else hidden[rows]
        windows = _Windows(net, mine, unread, x.shape[1], window, overlap)
        return net.config.schedule.denoise(windows.denoise, x, noise, sampler, steps)

    frames = [groups * GROUP_FRAMES for groups in codes.groups.tolist()]
    with evaluating(net):
        return by_length(frames, seeds, net.motion_dim, codes.groups.device, denoised)


def window_starts(frames: int, window: int, overlap: int) -> list[int]:
    """First frames of the windows that cover `frames`; the last one ends with the motion."""
    last = frames - window
    if last <= 0:
        return [0]
    return [*range(0, last, window - overlap), last]


def blend_weights(starts: Sequence[int], window: int, overlap: int, frames: int) -> Tensor:
    """Share of each window in each frame, float64 [K, frames], summing to 1 over K.

    A window's weight rises linearly over its first `overlap` frames and falls over its last, but not at the
    ends of the motion.
    """
    place = torch.arange(window, dtype=torch.float64)
    weights = torch.zeros(len(starts), frames, dtype=torch.float64)
    for row, start in enumerate(starts):
        weight = torch.ones(window, dtype=torch.float64)
        if row > 0:
            weight = torch.minimum(weight, (place + 1) / (overlap + 1))
        if row < len(starts) - 1:
            weight = torch.minimum(weight, (window - place) / (overlap + 1))
        weights[row, start : start + window] = weight
    return weights / weights.sum(0)


class _Windows:
    """The windows of n motions of one length, whole groups, their tokens encoded once."""

    def __init__(
        self,
        net: Dmd,
        codes: Mapping[str, Tensor],
        hidden: Tensor | None,
        frames: int,
        window: int,
        overlap: int,
    ) -> None:
        self.net = net
        self.frames = frames
        self.size = min(window, frames)
        self.starts = window_starts(frames, window, overlap)
        cut = {name: self._cut(values, net.pattern.count(name)) for name, values in codes.items()}
        rows = next(iter(cut.values()))
        self.length = torch.full((len(rows),), self.size, device=rows.device)
        unread = None if hidden is None else self._cut(hidden, 1)
        self.condition = net.encode_tokens(cut, self.length // GROUP_FRAMES, unread)
        self.weights = blend_weights(self.starts, self.size, overlap, frames).float().to(rows.device)

    def _cut(self, values: Tensor, per: int) -> Tensor:
        """[n, G * per] of whole motions -> [n * K, W / 4 * per] of their windows."""
        pieces = [
            values[:, start // GROUP_FRAMES * per : (start + self.size) // GROUP_FRAMES * per]
            for start in self.starts
        ]
        return torch.stack(pieces, dim=1).flatten(0, 1)

    def denoise(self, x: Tensor, step: Tensor) -> Tensor:
        """The network's prediction for motions x [n, T, D] at one time step."""
        count = len(x)
        number = len(self.starts)
        cut = torch.stack([x[:, s : s + self.size] for s in self.starts], dim=1).flatten(0, 1)
        mask = length_mask(self.length, self.size)
        found = self.net.denoise(cut, step.to(x.device).expand(len(cut)), self.condition, mask)
        if number == 1:
            return found
        found = found.view(count, number, *found.shape[1:])
        out = torch.zeros_like(x, dtype=found.dtype)
        for k, start in enumerate(self.starts):
            inside = slice(start, start + self.size)
            out[:, inside] += self.weights[k, inside, None] * found[:, k]
        return out
