"""Sampling settings of generators."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from motionloom.datasets.base.config import Config
from motionloom.datasets.motion.layout import Part
from motionloom.models.diffusion.schedule import Sampler

Guidance = Annotated[float, Field(ge=1, le=1e6)]


class SamplingConfig(Config):
    """Settings of drawing tokens, latents and noise; unset fields are as the model recommends."""

    temperature: float = Field(1.0, ge=0, le=10)
    """Below 1 safer, above 1 more varied; 0 is greedy: the likeliest token, a latent's mean."""
    top_k: int = Field(0, ge=0)
    """Draw from the k likeliest tokens; 0 keeps every token."""
    top_p: float = Field(0.95, gt=0, le=1)
    """Draw from the likeliest tokens of this total probability."""
    candidates: int = Field(1, ge=1, le=64)
    """Motions drawn for each text, of which the one that TMA finds nearest to it is kept; 1 takes the first.
    Needs a GPT whose prior is TMA's."""
    cfg_scale: Guidance = 1.0
    """Classifier-free guidance; 1 is off. Needs a model trained with `condition_dropout` > 0."""
    guidance: dict[str, Guidance] = Field(default_factory=dict)
    """Guidance in place of `cfg_scale` where a motion is conditioned on a modality, by the modality's name:
    `{audio: 1.0}`. Of several the first that is present counts."""
    face_cfg_scale: Guidance | None = None
    """Guidance of the face's GPT or diffusion model; None takes `cfg_scale`."""
    face_model: str | None = None
    """The face generator, by its method (gpt, vae, diffusion) or its stage; by default the first."""
    sampler: Sampler | None = None
    """Sampler of diffusion models: ddpm, ddim or dpm++; None takes the model's own (ddpm, of UDE its
    stage's)."""
    denoising_steps: int | None = Field(None, ge=1)
    """Steps of diffusion models, at most those of the training; None takes the model's own (50, of UDE its
    stage's)."""

    @staticmethod
    def of(given: SamplingConfig | Mapping[str, object] | None) -> SamplingConfig:
        """Return the config; a mapping such as `{"top_p": 0.9}` is parsed."""
        return SamplingConfig.parse({} if given is None else given, "sampling")

    def over(self, recommended: SamplingConfig) -> SamplingConfig:
        """Return these settings, with unset fields from `recommended`."""
        return recommended.model_copy(update={name: getattr(self, name) for name in self.model_fields_set})

    def scale(self, present: Mapping[str, bool]) -> float:
        """Return the guidance scale of a motion with these modalities present."""
        return next((self.guidance[name] for name in self.guidance if present.get(name)), self.cfg_scale)

    def guidance_of(self, part: Part) -> float:
        """Return the guidance scale of a generator of that part."""
        return self.face_cfg_scale if part == "face" and self.face_cfg_scale is not None else self.cfg_scale
