"""What a user asks of a model, checked before it is made: captions, seed, options without effect."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from numbers import Integral
from typing import Any

from motionloom.datasets.schema import UserError
from motionloom.pipeline.inference.faces import DiffusionFace, FaceGenerator, FaceKind, VaeFace, choose
from motionloom.pipeline.inference.sampling import SamplingConfig

_OF_DIFFUSION = {"sampler": "--sampler", "denoising_steps": "--steps"}


def caption_list(given: Iterable[str], name: str = "captions") -> list[str]:
    """The captions as a list; one text alone would be taken for a list of letters, so it is refused."""
    if isinstance(given, str):
        raise UserError(f"{name} is one text; give a list, also of one: {name}=[{given!r}]")
    out = list(given)
    for row, caption in enumerate(out):
        if not isinstance(caption, str):
            raise UserError(f"{name}[{row}] = {caption!r:.60}: not a text; give a list of texts")
    return out


def require_words(captions: Iterable[str], name: str = "captions") -> None:
    """Refuse captions that say nothing."""
    for row, caption in enumerate(captions):
        if not caption.strip():
            raise UserError(f"{name}[{row}] is empty; say what the person does")


def require_seed(seed: int) -> None:
    """Refuse what is no seed."""
    if not isinstance(seed, Integral) or seed < 0:
        raise UserError(f"seed {seed}: a seed is a whole number, 0 or more")


def sampling_of(given: SamplingConfig | Mapping[str, Any] | None) -> SamplingConfig:
    """The config, also of a mapping with its keys."""
    return SamplingConfig.parse({} if given is None else given, "sampling")


def require_used(
    faces: dict[FaceKind, FaceGenerator], face_captions: Iterable[str] | None, sampling: SamplingConfig
) -> None:
    """Refuse options that were given, and that this model's face takes no notice of."""
    face = choose(faces, sampling.face_model)
    if face is None:
        if face_captions is not None:
            raise UserError("this model makes no face: leave the face captions (--face) out")
        if sampling.face_cfg_scale is not None:
            raise UserError("this model makes no face: leave face_cfg_scale (--face-cfg) out")
    if isinstance(face, VaeFace) and sampling.face_cfg_scale is not None:
        raise UserError("the face's VAE knows no guidance: leave face_cfg_scale (--face-cfg) out")
    unused = [name for name in _OF_DIFFUSION if name in sampling.model_fields_set]
    if unused and not isinstance(face, DiffusionFace):
        told = " and ".join(f"{name} ({_OF_DIFFUSION[name]})" for name in unused)
        fix = "choose --face-model diffusion, or leave it out" if "diffusion" in faces else "leave it out"
        raise UserError(f"{told}: only a diffusion model takes it, and none is used here; {fix}")
