"""How motions are drawn from trained models."""

from __future__ import annotations

from pydantic import Field

from motionloom.datasets.schema import Config
from motionloom.models.diffusion.schedule import Sampler
from motionloom.pipeline.contract.fingerprint import LATER


class SamplingConfig(Config):
    """How tokens, latents and noise are drawn."""

    temperature: float = Field(1.0, ge=0)
    """Below 1 safer, above 1 more varied; 0 is greedy: the likeliest token, a latent's mean."""
    top_k: int = Field(0, ge=0)
    """0 keeps every token."""
    top_p: float = Field(0.95, gt=0, le=1)
    candidates: int = Field(1, ge=1, le=64, json_schema_extra=LATER)
    """Motions drawn for each text, of which the one that TMA finds nearest to it is kept; 1 takes the first.
    Needs a GPT whose prior is TMA's."""
    cfg_scale: float = Field(1.0, ge=1)
    """Classifier-free guidance; 1 is off. Needs a model trained with `condition_dropout` > 0."""
    music_cfg_scale: float | None = Field(None, ge=1)
    """The same where there is music; None takes `cfg_scale`."""
    face_cfg_scale: float | None = Field(None, ge=1)
    """The same of the face's GPT or diffusion model; None takes `cfg_scale`."""
    face_model: str | None = None
    """Which face generator, by its method (gpt, vae, diffusion) or its stage; by default the first."""
    sampler: Sampler = "ddpm"
    """Sampler of diffusion models."""
    denoising_steps: int = Field(50, ge=1)
    """Steps of diffusion models, at most those of the training; the paper takes all 1000."""

    @property
    def music_guidance(self) -> float:
        """Guidance where there is music."""
        return self.cfg_scale if self.music_cfg_scale is None else self.music_cfg_scale

    @property
    def face_guidance(self) -> float:
        """Guidance of the face generator."""
        return self.cfg_scale if self.face_cfg_scale is None else self.face_cfg_scale
