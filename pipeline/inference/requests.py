"""Check a user's request to a model, and encode it as networks take it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from numbers import Integral
from typing import TYPE_CHECKING, SupportsFloat

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.conditions import Condition, Conditions
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.contract.generation import MotionGenerator, Prompt
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import CompletedStage
from motionloom.pipeline.store.weights import MODEL_FILES

if TYPE_CHECKING:
    from motionloom.datasets.audio.sound import Sound


_BEYOND = 0.5
"""Seconds that a motion may be longer than its music."""

_OPTIONS = ("candidates", "face_cfg_scale", "guidance", "sampler", "denoising_steps")
"""Settings that only some generators take."""


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


def lengths_of(seconds: object) -> float | list[float | None] | None:
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


def sound_list(given: object) -> list[Sound | None]:
    """The sounds as a list; refuses what are no sounds, such as names of files."""
    from motionloom.datasets.audio.sound import Sound

    if isinstance(given, (Sound, str)) or not isinstance(given, Iterable):
        raise UserError("sounds: give a list, also of one: sounds=[Sound.read('song.wav')]")
    out = list(given)
    for row, sound in enumerate(out):
        if not isinstance(sound, (Sound, type(None))):
            raise UserError(f"sounds[{row}] = {sound!r:.60}: no sound; read a file by Sound.read")
    return out


def prompts_of(
    captions: Sequence[str] | None,
    faces: Sequence[str] | None,
    sounds: Sequence[Sound | None] | None,
    conditions: Mapping[str, Sequence[object]] | None = None,
) -> list[Prompt]:
    """Return a prompt for each motion; a single face caption is used for all, `conditions` by modality."""
    more = conditions or {}
    given: dict[str, Sequence[object] | None] = {"captions": captions, "sounds": sounds, **more}
    counts = {name: len(values) for name, values in given.items() if values is not None}
    if not counts:
        raise UserError("nothing to generate from: give captions, sounds or both")
    if len(set(counts.values())) > 1:
        raise UserError(" but ".join(f"{count} {name}" for name, count in counts.items()))
    count = next(iter(counts.values()))
    if faces is not None and len(faces) not in (1, count):
        raise UserError(f"{count} captions but {len(faces)} face captions; give one, or one for each")
    return [
        Prompt(
            text=captions[row] if captions else "",
            face_text=faces[row if len(faces) > 1 else 0] if faces else "",
            sound=sounds[row] if sounds else None,
            conditions={name: values[row] for name, values in more.items()},
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
            other = "; the package's model `dance` takes music" if name == "audio" else ""
            raise UserError(f"prompt {row} has {name}, and this model is conditioned on {known} only{other}")


def require_used(
    body: MotionGenerator,
    faces: Mapping[str, MotionGenerator],
    face: MotionGenerator | None,
    face_captions: Iterable[str] | None,
    sampling: SamplingConfig,
) -> None:
    """Refuse given settings that neither the body's generator nor `face` uses; `faces`: for the fix."""
    if face is None and face_captions is not None:
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
    generator: MotionGenerator, seconds: float | Sequence[float | None] | None, prompts: Sequence[Prompt]
) -> list[int | None]:
    """Length of each motion in frames, in whole units of the generator; None where the model decides.

    Args:
        seconds: One length for all, one for each, or None: as long as what the prompt brings, such as music.
    """
    fps, unit, most = generator.layout.fps, generator.unit_frames, generator.max_frames
    seed_frames = generator.capabilities.seed_frames
    if seconds is None:
        wanted: list[float | None] = [prompt.seconds for prompt in prompts]
    else:
        wanted = list(seconds) if isinstance(seconds, Iterable) else [seconds] * len(prompts)
    if len(wanted) != len(prompts):
        raise UserError(f"{len(prompts)} captions but {len(wanted)} lengths in seconds")
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


def alike(frames: Sequence[int | None], batch: int) -> list[list[int]]:
    """Rows in batches, each all with a given length or all without."""
    free = [row for row, count in enumerate(frames) if count is None]
    given = [row for row, count in enumerate(frames) if count is not None]
    return [rows[i : i + batch] for rows in (free, given) for i in range(0, len(rows), batch)]


def seeds_of(
    generator: MotionGenerator, given: Sequence[NDArray[np.float32]] | None, count: int
) -> list[NDArray[np.float32]] | None:
    """The last frames of motions [T, D] in the layout's columns, as a request has them; one may be for all.

    Refuses those that are too short, or that nothing would go on from.
    """
    if given is None:
        return None
    layout, frames = generator.layout, generator.capabilities.seed_frames
    if not frames:
        raise UserError(f"this model ({generator.method}) goes on from no motion: leave the seed motion out")
    if len(given) not in (1, count):
        raise UserError(f"{count} motions but {len(given)} seed motions; give one, or one for each")
    for motion in given:
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
    columns = layout.part(generator.part)
    own = [np.asarray(motion[-frames:, columns], np.float32) for motion in given]
    return own * count if len(own) == 1 else own


def encode_prompts(
    generator: MotionGenerator,
    prompts: Sequence[Prompt],
    words: Sequence[str],
    fps: float,
    device: torch.device,
) -> Conditions:
    """The conditions of a generator, by what it was trained with; those that no prompt has are left out.

    `words` are the prompts' texts, about the body or the face; an empty one is no text.
    """
    rows = [replace(prompt, text=text).given for prompt, text in zip(prompts, words, strict=True)]
    out: dict[str, Condition] = {}
    for name, record in MODALITIES.items():
        given = [row.get(name) for row in rows]
        if name in generator.modalities and any(value is not None for value in given):
            features, mask, pooled = record.encode(generator.prepared.get(name), given, fps)
            pooled = None if pooled is None else pooled.to(device)
            out[name] = Condition(features.to(device), mask.to(device), pooled)
    return out


def ticks_of(prompt: Prompt, conditions: Conditions, row: int, fps: float) -> tuple[float, ...]:
    """Seconds worth marking on the time line of a row of encoded conditions: the beats of its music."""
    found: list[float] = []
    for name, (features, mask, _) in conditions.items():
        values = np.asarray(features[row][mask[row]].cpu(), np.float32)
        found += MODALITIES[name].ticks(prompt.given.get(name), values, fps)
    return tuple(found)


def repeated_rows(conditions: Conditions, count: int) -> Conditions:
    """Conditions of one row, for `count` rows."""
    return {
        name: Condition(
            features.expand(count, -1, -1),
            mask.expand(count, -1),
            None if pooled is None else pooled.expand(count, -1),
        )
        for name, (features, mask, pooled) in conditions.items()
    }


def weight_bytes(stages: Iterable[CompletedStage]) -> int:
    """Size of the networks of some stages."""
    files = (stage.folder / MODEL_FILES[0] for stage in stages)
    return sum(path.stat().st_size for path in files if path.is_file())


def split_columns(
    motion: NDArray[np.float32], generator: MotionGenerator, layout: MotionLayout
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Body-hand features and, of a generator that makes all columns, the expression."""
    if generator.part != "all" or not layout.has("face"):
        return motion, None
    return motion[:, layout.part("bodyhand")], motion[:, layout.part("face")]
