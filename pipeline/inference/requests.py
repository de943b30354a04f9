"""What a user asks of a model, checked before it is made: captions, seed, options without effect."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.generation import MotionGenerator, Prompt
from motionloom.pipeline.contract.sampling import SamplingConfig

if TYPE_CHECKING:
    from motionloom.datasets.audio.sound import Sound

_OPTIONS = ("candidates", "face_cfg_scale", "music_cfg_scale", "sampler", "denoising_steps")
"""Settings that some generators take; the command line calls them by the same words."""


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


def prompts_of(
    captions: Sequence[str] | None,
    faces: Sequence[str] | None,
    sounds: Sequence[Sound | None] | None,
    music: Sequence[NDArray[np.float32] | None] | None = None,
) -> list[Prompt]:
    """One prompt a motion from lists of equal length; None is left out. `music` goes with `sounds`."""
    given = {"captions": captions, "sounds": sounds}
    counts = {name: len(values) for name, values in given.items() if values is not None}
    if not counts:
        raise UserError("nothing to generate from: give captions, sounds or both")
    if len(set(counts.values())) > 1:
        raise UserError(" but ".join(f"{count} {name}" for name, count in counts.items()))
    count = next(iter(counts.values()))
    if music is not None and (sounds is None or len(music) != count):
        raise UserError(f"{len(music)} rows of music features but {len(sounds or [])} sounds")
    if faces is not None and len(faces) != count:
        raise UserError(f"{count} captions but {len(faces)} face captions")
    return [
        Prompt(
            text=captions[row] if captions else "",
            face_text=faces[row] if faces else "",
            sound=sounds[row] if sounds else None,
            music=music[row] if music else None,
        )
        for row in range(count)
    ]


def require_driven(generator: MotionGenerator, prompts: Iterable[Prompt]) -> None:
    """Refuse prompts that say nothing, or that have what a model is not conditioned on."""
    for row, prompt in enumerate(prompts):
        if not prompt.modalities:
            raise UserError(f"captions[{row}] is empty; say what the person does")
        for name in sorted(prompt.modalities - generator.modalities):
            known = " and ".join(sorted(generator.modalities))
            raise UserError(f"prompt {row} has {name}, and this model is conditioned on {known} only")


class _Chooses(Protocol):
    @property
    def stages(self) -> Sequence[Any]: ...
    @property
    def faces(self) -> Mapping[str, Any]: ...
    @property
    def generator(self) -> MotionGenerator: ...
    def choose_face(self, wanted: str | None) -> Any: ...
    def of(self, stage: Any) -> MotionGenerator: ...


def require_used(model: _Chooses, face_captions: Iterable[str] | None, sampling: SamplingConfig) -> None:
    """Refuse options that were given, and that no generator in use takes notice of."""
    face = model.choose_face(sampling.face_model)
    if face is None:
        if face_captions is not None:
            raise UserError("this model makes no face: leave the face captions (--face) out")
        if sampling.face_cfg_scale is not None:
            raise UserError("this model makes no face: leave face_cfg_scale (--face-cfg-scale) out")
    used = model.generator.settings | (model.of(face).settings if face is not None else frozenset())
    unused = [
        name
        for name in _OPTIONS
        if name in sampling.model_fields_set and getattr(sampling, name) is not None and name not in used
    ]
    if unused:
        named = " and ".join(f"{name} (--{name.replace('_', '-')})" for name in unused)
        takers = [m for m, s in model.faces.items() if set(unused) <= model.of(s).settings]
        fix = f"choose --face-model {takers[0]}, or leave it out" if takers else "leave it out"
        raise UserError(f"{named}: no generator that is used here takes it; {fix}")
