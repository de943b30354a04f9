"""`Request`: what is asked of a model, checked in one place.

`Request.of` refuses what no model could take; the functions below refuse what one model cannot.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.contract.generation import MotionGenerator, Prompt
from motionloom.pipeline.contract.sampling import SamplingConfig

if TYPE_CHECKING:
    from motionloom.datasets.audio.sound import Sound
    from motionloom.pipeline.inference.script import DrivenSegment, Script

Columns = NDArray[np.float32]
"""A layout's columns of a motion [T, D]."""

_BEYOND = 0.5
"""Seconds that a motion may be longer than its music."""

_OPTIONS = ("candidates", "face_cfg_scale", "guidance", "sampler", "denoising_steps")
"""Settings that only some generators take."""


@dataclass(frozen=True)
class Request:
    """Motions that are asked of a model, one a prompt; or one motion along the segments of a script, several
    times.
    """

    prompts: tuple[Prompt, ...]
    lengths: tuple[float | None, ...]
    """Seconds of each; None where what its prompt brings, such as music, or else the model decides. A
    script's segments have their own."""
    seed: int = 0
    """Equal requests give equal motions; the draws of one go by its place."""
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    """What is not set is as the model recommends."""
    noise_seed: int | None = None
    """Decodes the same tokens with other noise, where a diffusion model decodes."""
    seed_motions: tuple[Path | Columns, ...] = ()
    """Clips, or the layout's columns of motions, that a model with `seed_frames` goes on from: one for each
    motion or one for all."""
    segments: tuple[DrivenSegment, ...] = ()
    """Those of a script, whose prompts these are."""
    samples: int = 1
    """Motions of a script."""

    @classmethod
    def of(
        cls,
        captions: Iterable[str] | None = None,
        *,
        face: Iterable[str] | None = None,
        sounds: Iterable[Sound | None] | None = None,
        conditions: Mapping[str, Sequence[object]] | None = None,
        seconds: object = None,
        seed: int = 0,
        noise_seed: int | None = None,
        sampling: SamplingConfig | Mapping[str, object] | None = None,
        seed_motions: Path | str | Columns | Sequence[Columns] | None = None,
    ) -> Request:
        """The request that these arguments of `MotionModel.generate` make. `UserError` for what is none."""
        require_seed(seed)
        given: dict[str, Sequence[object] | None] = {
            "captions": None if captions is None else caption_list(captions),
            "sounds": None if sounds is None else _sound_list(sounds),
            **(conditions or {}),
        }
        prompts = _prompts_of(given, None if face is None else caption_list(face, "face"))
        lengths = _lengths_of(seconds)
        if not isinstance(lengths, list):
            lengths = [lengths] * len(prompts)
        if len(lengths) != len(prompts):
            raise UserError(f"{len(prompts)} captions but {len(lengths)} lengths in seconds")
        begun: tuple[Path | Columns, ...] = ()
        if isinstance(seed_motions, (str, Path)):
            begun = (Path(seed_motions),)
        elif seed_motions is not None:
            # Columns of one motion are a matrix; of several a list, whose length is checked with the model.
            begun = (seed_motions,) if isinstance(seed_motions, np.ndarray) else tuple(seed_motions)
        return cls(prompts, tuple(lengths), seed, SamplingConfig.of(sampling), noise_seed, begun)

    @classmethod
    def of_script(
        cls,
        script: Path | str | Script,
        *,
        samples: int = 1,
        seed: int = 0,
        sampling: SamplingConfig | Mapping[str, object] | None = None,
    ) -> Request:
        """`samples` motions of a script: a file, or a `Script` whose sounds are seen from the current
        folder."""
        from motionloom.pipeline.inference.script import Script

        require_seed(seed)
        require_samples(samples)
        segments = tuple(script.open() if isinstance(script, Script) else Script.read(Path(script)))
        prompts = tuple(segment.prompt for segment in segments)
        return cls(prompts, (), seed, SamplingConfig.of(sampling), segments=segments, samples=samples)

    @property
    def count(self) -> int:
        """How many motions it asks for."""
        return self.samples if self.segments else len(self.prompts)

    def alone(self, row: int) -> Request:
        """The request for one of its motions."""
        if self.segments:
            return replace(self, samples=1)
        return replace(self, prompts=self.prompts[row : row + 1], lengths=self.lengths[row : row + 1])


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


def require_samples(samples: int) -> None:
    """Refuse what is no number of motions."""
    if not isinstance(samples, Integral) or isinstance(samples, bool) or samples < 1:
        raise UserError(f"samples {samples}: a whole number, 1 or more")


def _lengths_of(seconds: object) -> float | list[float | None] | None:
    """Lengths in seconds as plain numbers: one, or one for each motion; None where the model decides."""

    def plain(value: object) -> float | None:
        if value is None:
            return None
        if not isinstance(value, SupportsFloat) or isinstance(value, (bool, np.bool_)):
            raise TypeError
        return float(value)

    try:
        if (
            isinstance(seconds, Iterable)
            and not isinstance(seconds, str)
            and getattr(seconds, "ndim", 1) != 0
        ):
            return [plain(value) for value in seconds]
        return plain(seconds)
    except (TypeError, ValueError):
        raise UserError(f"seconds {seconds!r:.60}: a number, or a list with one for each motion") from None


def _sound_list(given: object) -> list[Sound | None]:
    """The sounds as a list; refuses what are no sounds, such as names of files."""
    from motionloom.datasets.audio.sound import Sound

    if isinstance(given, (Sound, str)) or not isinstance(given, Iterable):
        raise UserError("sounds: give a list, also of one: sounds=[Sound.read('song.wav')]")
    out = list(given)
    for row, sound in enumerate(out):
        if not isinstance(sound, (Sound, type(None))):
            raise UserError(f"sounds[{row}] = {sound!r:.60}: no sound; read a file by Sound.read")
    return out


def _prompts_of(given: Mapping[str, Sequence[Any] | None], faces: Sequence[str] | None) -> tuple[Prompt, ...]:
    """Return a prompt for each motion of captions, sounds and other conditions, by name; a single face
    caption is used for all.
    """
    rows = {name: values for name, values in given.items() if values is not None}
    counts = {name: len(values) for name, values in rows.items()}
    if not counts:
        raise UserError("nothing to generate from: give captions, sounds or both")
    if len(set(counts.values())) > 1:
        raise UserError(" but ".join(f"{count} {name}" for name, count in counts.items()))
    count = next(iter(counts.values()))
    if faces is not None and len(faces) not in (1, count):
        raise UserError(f"{count} captions but {len(faces)} face captions; give one, or one for each")
    shared = [""] * count if not faces else [*faces] * (count if len(faces) == 1 else 1)
    captions = rows.pop("captions", [""] * count)
    sounds = rows.pop("sounds", [None] * count)
    return tuple(
        Prompt(captions[row], shared[row], sounds[row], {name: values[row] for name, values in rows.items()})
        for row in range(count)
    )


def require_driven(generator: MotionGenerator, prompts: Iterable[Prompt]) -> None:
    """Refuse prompts that say nothing, or that have what a model is not conditioned on."""
    for row, prompt in enumerate(prompts):
        if not prompt.modalities:
            raise UserError(f"captions[{row}] is empty; say what the person does")
        for name in sorted(prompt.modalities - generator.modalities):
            known = " and ".join(sorted(generator.modalities))
            other = "; the package's model `dance` takes music" if name == "audio" else ""
            raise UserError(f"prompt {row} has {name}, and this model is conditioned on {known} only{other}")


def require_used(
    body: MotionGenerator,
    faces: Mapping[str, MotionGenerator],
    face: MotionGenerator | None,
    sampling: SamplingConfig,
    prompts: Iterable[Prompt] = (),
) -> None:
    """Refuse face captions, and given settings, that neither the body's generator nor `face` uses; `faces`:
    for the fix.
    """
    if face is None and any(prompt.face_text for prompt in prompts):
        raise UserError("this model makes no face: leave the face captions out")
    used = body.settings | (frozenset() if face is None else face.settings)
    given = {name for name in sampling.model_fields_set if getattr(sampling, name) not in (None, {})}
    unused = [name for name in _OPTIONS if name in given - used]
    if unused:
        takers = [method for method, one in faces.items() if set(unused) <= one.settings]
        fix = f"set face_model to {takers[0]}, or leave it out" if takers else "leave it out"
        raise UserError(f"{' and '.join(unused)}: no generator that is used here takes it; {fix}")
    for name in sampling.guidance:
        if name not in body.modalities:
            known = " and ".join(sorted(body.modalities))
            raise UserError(f"guidance.{name}: this model is conditioned on {known} only; leave it out")


def frames_of(
    generator: MotionGenerator, lengths: Sequence[float | None], prompts: Sequence[Prompt]
) -> list[int | None]:
    """Length of each motion in frames, in whole units of the generator; None where the model decides."""
    fps = generator.layout.fps
    unit = generator.unit_frames
    most = generator.max_frames
    seed_frames = generator.capabilities.seed_frames
    wanted = [p.seconds if length is None else length for length, p in zip(lengths, prompts, strict=True)]
    out: list[int | None] = []
    for length, prompt in zip(wanted, prompts, strict=True):
        if length is None:
            out.append(None)
            continue
        if prompt.seconds is not None and prompt.seconds + _BEYOND < length < math.inf:
            raise UserError(
                f"{length:g} s were asked for and the music lasts {prompt.seconds:.1f} s; take at most as "
                f"many seconds"
            )
        units = round(length * fps / unit) if math.isfinite(length) else 0
        if 0 < units * unit <= seed_frames:
            raise UserError(
                f"{length:g} s were asked for, and the first {seed_frames / fps:g} s are what this "
                f"model goes on from; ask for more"
            )
        if units < 1 or (most is not None and units * unit > most):
            least = unit / fps
            span = f"any length from {least:.1f} s" if most is None else f"{least:.2g} to {most / fps:.1f} s"
            raise UserError(f"{length:g} s is out of reach: this model makes {span}")
        out.append(units * unit)
    return out


def seeds_of(generator: MotionGenerator, given: Sequence[Path | Columns], count: int) -> list[Columns] | None:
    """The last frames of the motions that a generator goes on from, as it takes them: one for each of
    `count`.

    Refuses those that are too short, or that nothing would go on from.
    """
    if not given:
        return None
    layout = generator.layout
    frames = generator.capabilities.seed_frames
    if not frames:
        raise UserError(f"this model ({generator.method}) goes on from no motion: leave the seed motion out")
    if len(given) not in (1, count):
        raise UserError(f"{count} motions but {len(given)} seed motions; give one, or one for each")
    own = []
    for one in given:
        motion = one
        if isinstance(motion, Path):
            from motionloom.pipeline.inference.clip_file import read_seed_motion

            motion = read_seed_motion(motion, layout)
        if motion.ndim != 2 or motion.shape[1] != layout.dim or not np.isfinite(motion).all():
            raise UserError(
                f"a seed motion is finite columns [T, {layout.dim}] of layout {layout.name}, not "
                f"{list(motion.shape)}"
            )
        if len(motion) < frames:
            raise UserError(
                f"a seed motion of {len(motion)} frames: this model goes on from {frames} "
                f"({frames / layout.fps:g} s); give a longer one"
            )
        own.append(np.asarray(motion[-frames:, layout.part(generator.part)], np.float32))
    return own * count if len(own) == 1 else own
