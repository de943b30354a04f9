"""Noise schedules and samplers: all of them diffusers' own, built from one config.

diffusers takes seconds to import, so each is imported where it is built: a command that lists or plans stages
starts without it.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from motionloom.datasets.schema import Config, UserError

Sampler = Literal["ddpm", "ddim", "dpm++"]


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

    def noiser(self) -> Any:
        """For training: `add_noise`. Motion is not bounded, so nothing is clipped."""
        from diffusers import DDPMScheduler

        return DDPMScheduler(clip_sample=False, **self.arguments())  # type: ignore[no-untyped-call]

    def sampler(self, kind: Sampler, steps: int) -> Any:
        """A sampler set to `steps` denoising steps, at most those of the training."""
        if steps > self.steps:
            raise UserError(
                f"{steps} denoising steps are more than the {self.steps} of this model's training; take fewer"
            )
        made: Any
        if kind == "ddpm":
            made = self.noiser()
        elif kind == "ddim":
            from diffusers import DDIMScheduler

            made = DDIMScheduler(  # type: ignore[no-untyped-call]
                clip_sample=False, set_alpha_to_one=True, **self.arguments()
            )
        else:
            from diffusers import DPMSolverMultistepScheduler

            made = DPMSolverMultistepScheduler(  # type: ignore[no-untyped-call]
                algorithm_type="dpmsolver++", **self.arguments()
            )
        made.set_timesteps(steps)
        return made
