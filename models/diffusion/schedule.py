"""Noise schedules and samplers: all of them diffusers' own, built from one config.

diffusers takes seconds to import, so each is imported where it is built: a command that lists or plans stages
starts without it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, Literal, Protocol

import torch
from pydantic import Field
from torch import Tensor

from motionloom.datasets.schema import Config, UserError

Sampler = Literal["ddpm", "ddim", "dpm++"]


class StepOutput(Protocol):
    """Result of a denoising step."""

    prev_sample: Tensor


class Scheduler(Protocol):
    """What is used of diffusers' schedulers."""

    timesteps: Tensor
    init_noise_sigma: float

    def scale_model_input(self, sample: Tensor, timestep: Tensor) -> Tensor: ...

    def add_noise(self, original_samples: Tensor, noise: Tensor, timesteps: Tensor) -> Tensor: ...

    def set_timesteps(self, num_inference_steps: int) -> None: ...

    def step(self, model_output: Tensor, timestep: Tensor, sample: Tensor, **more: object) -> StepOutput: ...


class ScheduleConfig(Config):
    """The noising process; the defaults are MDM's, which HumanTOMATO's facial baseline follows (B.5.2)."""

    steps: int = Field(default=1000, ge=2)
    betas: Literal["squaredcos_cap_v2", "linear"] = "squaredcos_cap_v2"
    """Cosine (MDM) or linear from 1e-4 to 0.02 (UDE), by diffusers' names."""
    predicts: Literal["sample", "epsilon"] = "sample"
    """x0 (MDM) or the noise (UDE)."""

    def arguments(self) -> dict[str, Any]:
        """What every scheduler is built from."""
        return {
            "num_train_timesteps": self.steps,
            "beta_schedule": self.betas,
            "beta_start": 1e-4,
            "beta_end": 0.02,
            "prediction_type": self.predicts,
        }

    def noiser(self) -> Scheduler:
        """For training: `add_noise`. Motion is not bounded, so nothing is clipped."""
        from diffusers import DDPMScheduler

        made: Scheduler = DDPMScheduler(clip_sample=False, **self.arguments())  # type: ignore
        return made

    def sampler(self, kind: Sampler, steps: int) -> Scheduler:
        """A sampler set to `steps` denoising steps, at most those of the training."""
        if steps > self.steps:
            raise UserError(
                f"{steps} denoising steps are more than the {self.steps} of this model's training; take fewer"
            )
        made: Scheduler
        if kind == "ddpm":
            made = self.noiser()
        elif kind == "ddim":
            from diffusers import DDIMScheduler

            made = DDIMScheduler(  # type: ignore
                clip_sample=False, set_alpha_to_one=True, **self.arguments()
            )
        else:
            from diffusers import DPMSolverMultistepScheduler

            made = DPMSolverMultistepScheduler(  # type: ignore
                algorithm_type="dpmsolver++", **self.arguments()
            )
        made.set_timesteps(steps)
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
        extra = {} if kind == "dpm++" else {"generator": noise}
        for step in scheduler.timesteps:
            found = predict(scheduler.scale_model_input(x, step), step)
            stepped: Tensor = scheduler.step(found.to(x.dtype), step, x, **extra).prev_sample
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
