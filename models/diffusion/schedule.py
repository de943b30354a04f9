"""Noise schedules and samplers: all of them diffusers' own, built from one config.

Their tables are replaced by the same in float64: in float32 1 - beta of the last cosine steps is rounded in
its fifth digit.

diffusers takes seconds to import, so each is imported where it is built: a command that lists or plans stages
starts without it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError

Sampler = Literal["ddpm", "ddim", "dpm++"]

_NOISE = 0.9
"""Share of the training's steps at which motion is still as good as noise, so that drawing begins there."""


class StepOutput(Protocol):
    """Result of a denoising step."""

    prev_sample: Tensor


class Scheduler(Protocol):
    """The part of diffusers' schedulers that is used here."""

    timesteps: Tensor
    alphas_cumprod: Tensor
    init_noise_sigma: float

    def scale_model_input(self, sample: Tensor, timestep: Tensor) -> Tensor: ...

    def add_noise(self, original_samples: Tensor, noise: Tensor, timesteps: Tensor) -> Tensor: ...

    def set_timesteps(
        self, num_inference_steps: int | None = None, *, timesteps: list[int] | None = None
    ) -> None: ...

    def step(self, model_output: Tensor, timestep: Tensor, sample: Tensor, **more: object) -> StepOutput: ...


class ScheduleConfig(Config):
    """The noising process; the defaults are MDM's, which HumanTOMATO's facial baseline follows (B.5.2)."""

    steps: int = Field(default=1000, ge=2)
    betas: Literal["squaredcos_cap_v2", "linear", "scaled_linear"] = "squaredcos_cap_v2"
    """Cosine (MDM), linear from 1e-4 to 0.02 (UDE, MotionDiffuse), or between the roots of 0.00085 and 0.012
    (MLD), by diffusers' names."""
    predicts: Literal["sample", "epsilon"] = "sample"
    """x0 (MDM) or the noise (UDE, MotionDiffuse, MLD)."""
    steps_offset: int = Field(default=0, ge=0)
    """Added to each time step that ddpm and ddim take; MLD's is 1."""
    set_alpha_to_one: bool = True
    """Whether ddim's last step ends without noise; MLD's ends with that of time step 0."""

    shift: float = Field(default=1.0, gt=0)
    """How many times as strong as usual the noise is beside the motion, at every step. Where many columns
    move together, motion shows through noise that hides each column, so that small networks learn too little
    of what comes before: Hoogeboom et al. 2023 shift the noise of large images so. 1 is the papers'."""

    def beta_table(self) -> NDArray[np.float64]:
        """Variance that each step adds [steps]."""
        if self.shift == 1:
            return self._unshifted()
        kept = np.cumprod(1 - self._unshifted())
        kept = kept / (kept + self.shift**2 * (1 - kept))
        shifted: NDArray[np.float64] = np.minimum(1 - kept / np.append(1.0, kept[:-1]), 0.999)
        return shifted

    def _unshifted(self) -> NDArray[np.float64]:
        if self.betas == "linear":
            return np.linspace(1e-4, 0.02, self.steps)
        if self.betas == "scaled_linear":
            return np.linspace(0.00085**0.5, 0.012**0.5, self.steps) ** 2
        at = np.arange(self.steps + 1) / self.steps
        kept = np.cos((at + 0.008) / 1.008 * np.pi / 2) ** 2
        cosine: NDArray[np.float64] = np.minimum(1 - kept[1:] / kept[:-1], 0.999)
        return cosine

    def noiser(self) -> Scheduler:
        """For training: `add_noise`. Motion is not bounded, so nothing is clipped."""
        return self._ddpm(self.steps_offset)

    def _ddpm(self, offset: int) -> Scheduler:
        from diffusers import DDPMScheduler

        return self._made(DDPMScheduler, clip_sample=False, steps_offset=offset)

    def _ddim(self, offset: int) -> Scheduler:
        from diffusers import DDIMScheduler

        made: Any = self._made(DDIMScheduler, clip_sample=False, steps_offset=offset)
        if not self.set_alpha_to_one:
            made.final_alpha_cumprod = made.alphas_cumprod[0]
        scheduler: Scheduler = made
        return scheduler

    def _solver(self, order: int) -> Scheduler:
        from diffusers import DPMSolverMultistepScheduler

        last = "zero" if order > 1 or self.set_alpha_to_one else "sigma_min"
        how = {"algorithm_type": "dpmsolver++", "solver_order": order, "final_sigmas_type": last}
        return self._made(DPMSolverMultistepScheduler, **how)

    def _made(self, kind: Any, **options: object) -> Scheduler:
        """A scheduler of diffusers with tables in float64."""
        made = kind(num_train_timesteps=self.steps, prediction_type=self.predicts, **options)
        made.betas = torch.from_numpy(self.beta_table())
        made.alphas = 1 - made.betas
        made.alphas_cumprod = made.alphas.cumprod(0)
        scheduler: Scheduler = made
        return scheduler

    def sampler(self, kind: Sampler, steps: int) -> Scheduler:
        """A sampler set to `steps` denoising steps, at most those of the training."""
        if steps > self.steps:
            raise UserError(
                f"{steps} denoising steps are more than the {self.steps} of this model's training; take fewer"
            )
        if kind == "dpm++":
            made = self._solver(order=2)
            made.set_timesteps(steps)
            return made
        # Equal strides as published, where they reach the noise that motion is drawn from. diffusers rounds a
        # stride down otherwise, and begins as low as half of the training's noise.
        stride = self.steps // steps
        if self.steps % steps == 0 and self.steps - stride >= _NOISE * self.steps:
            # Where all steps of the training are taken there is no room for an offset.
            offset = min(self.steps_offset, stride - 1)
            made = self._ddpm(offset) if kind == "ddpm" else self._ddim(offset)
            made.set_timesteps(steps)
            return made
        # Strides that differ by one, from the last step down. DDIM takes equal ones only; it is the solver of
        # first order (Lu et al. 2022, section 4.1).
        trailing = np.round(self.steps * (1 - np.arange(steps) / steps)).astype(int) - 1
        made = self._ddpm(0) if kind == "ddpm" else self._solver(order=1)
        made.set_timesteps(timesteps=trailing.tolist())
        return made

    def denoise(
        self,
        predict: Callable[[Tensor, Tensor], Tensor],
        x: Tensor,
        noise: list[torch.Generator],
        kind: Sampler,
        steps: int,
    ) -> Tensor:
        """Motions [n, T, D] from standard normal x [n, T, D]; steps that draw do so from `noise`.

        `predict` says what the network predicts of noisy motions [n, T, D] at a time step.
        """
        scheduler = self.sampler(kind, steps)
        x = x * scheduler.init_noise_sigma
        for step in scheduler.timesteps:
            found = predict(scheduler.scale_model_input(x, step), step)
            stepped: Tensor = scheduler.step(found.to(x.dtype), step, x, generator=noise).prev_sample
            x = stepped
        return x


def by_length(
    frames: Sequence[int],
    seeds: Sequence[int],
    dim: int,
    device: torch.device,
    denoised: Callable[[list[int], Tensor, list[torch.Generator]], Tensor],
) -> list[Tensor]:
    """Motions [T, dim] of so many `frames`, one seed each: those of one length are denoised together.

    `denoised(rows, x, noise)` makes the motions [n, T, dim] of some rows from standard normal x [n, T, dim].
    Each row draws from its own seed, so a motion does not depend on what it is generated with.
    """
    groups: dict[int, list[int]] = defaultdict(list)
    for row, count in enumerate(frames):
        groups[count].append(row)
    out: dict[int, Tensor] = {}
    for count, rows in groups.items():
        noise = [torch.Generator().manual_seed(seeds[row]) for row in rows]
        x = torch.stack([torch.randn(count, dim, generator=g) for g in noise]).to(device)
        out.update(zip(rows, denoised(rows, x, noise), strict=True))
    return [out[row] for row in range(len(frames))]
