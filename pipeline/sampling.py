"""How motions are drawn from trained models."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from motionloom.datasets.schema import Config
from motionloom.models.diffusion.schedule import Sampler


class SamplingConfig(Config):
    """How tokens, latents and noise are drawn."""

    temperature: float = Field(1.0, gt=0)
    top_k: int = Field(0, ge=0)
    """0 keeps every token."""
    top_p: float = Field(0.95, gt=0, le=1)
    cfg_scale: float = Field(1.0, ge=1)
    """Classifier-free guidance; 1 is off. Needs a model trained with `condition_dropout` > 0."""
    face_model: Literal["gpt", "vae", "diffusion"] | None = None
    """Which of the run's face generators; by default the first it has, in this order."""
    sampler: Sampler = "ddpm"
    """Sampler of diffusion models."""
    denoising_steps: int = Field(50, ge=1)
    """Steps of diffusion models; the paper takes all 1000."""
