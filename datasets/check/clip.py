"""One sample as a stranger reads it: every member is parsed, nothing is believed.

The first thing that makes the clip unusable raises; what is merely odd is returned. Values have two limits a
field. Beyond the first, no person does it, but a glitch of one frame may: a warning. Beyond ten times the
first, it is no motion in metres and radians at all: an error (a wrong unit, scale or layout).
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.records import Caption, ClipMeta, ShardInfo
from motionloom.datasets.convert.common.config import END_TOLERANCE
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.sample import captions_from_json, meta_from_json, require_finite
from motionloom.datasets.shards.tar import TarClip, npy_from_bytes

ABSURD = 10.0
"""An error is this many times the first limit."""
LARGEST = 1e6
"""No feature of motion or music is larger, whatever it means."""


def require_sensible(what: str, values: NDArray[np.floating]) -> None:
    """`ValueError` naming the first row of [..., E] that holds NaN, infinity or a number beyond `LARGEST`."""
    require_finite(what, values)
    far = (np.abs(values) > LARGEST).any(axis=-1)
    if far.any():
        raise ValueError(f"{what}: absurd value in row {int(far.argmax())}; at most {LARGEST:g} is sensible")


_PER_SECOND = {
    "root_yaw_velocity": 40.0,  # six turns a second, a figure skater's record spin
    "root_xz_velocity": 15.0,  # sprinters reach 12.4
    "velocities": 40.0,  # the fastest hand stays below 30
}
"""Limits of columns that hold a change per frame, given a second."""

_PLAIN = {
    **dict.fromkeys(("root_height", "positions"), 4.0),  # heights are absolute: a jump with raised arms
    **dict.fromkeys(("rotations_6d", "foot_contacts"), 1.001),  # parts of unit vectors; 0 or 1
    **dict.fromkeys(("face", "face_shape", "betas"), 10.0),  # coefficients with a deviation near 1
    "trans": 30.0,  # a capture hall; AIST++ before its scaling is beyond it
    # More than one full turn says nothing new.
    **dict.fromkeys(("pose", "root_orient", "pose_body", "pose_hand", "pose_jaw"), 2 * math.pi),
}


def human_limits(layout: MotionLayout) -> NDArray[np.float64]:
    """Largest absolute value a person reaches, for every column [D]."""
    out = np.empty(layout.dim)
    for name, _ in layout.fields:
        out[layout.slice(name)] = _PER_SECOND[name] / layout.fps if name in _PER_SECOND else _PLAIN[name]
    return out


def beyond(
    motion: NDArray[np.floating], layout: MotionLayout, limits: NDArray[np.float64], factor: float = 1.0
) -> str:
    """Return the worst value of motion [T, D] beyond `factor` times the limits [D] and its place, or ""."""
    if motion.size == 0:
        return ""
    ratio = np.abs(motion).max(axis=0) / limits
    column = int(ratio.argmax())
    if not ratio[column] > factor:
        return ""
    frame = int(np.abs(motion[:, column]).argmax())
    part = next(name for name, _ in layout.fields if column < layout.slice(name).stop)
    at = column - layout.slice(part).start
    value = float(motion[frame, column])
    most = float(limits[column])
    unit = ""
    if part in _PER_SECOND:
        unit = " rad/s" if part == "root_yaw_velocity" else " m/s"
        value = value * layout.fps
        most = most * layout.fps
    return f"{part}[{at}] is {value:.4g}{unit} at frame {frame}; at most {most:.4g} is sensible"


def odd_value(motion: NDArray[np.floating], layout: MotionLayout) -> str:
    """Return the worst value that no person reaches, or ""; `ValueError` for one that no motion has."""
    limits = human_limits(layout)
    if absurd := beyond(motion, layout, limits, ABSURD):
        raise ValueError(f"absurd value: {absurd}: a wrong unit, scale or layout")
    return beyond(motion, layout, limits)


@dataclass(frozen=True)
class CheckedClip:
    """A clip that can be read. `oddities` are (kind, message)."""

    meta: ClipMeta
    motion: NDArray[np.floating]
    audio_width: int | None
    oddities: list[tuple[str, str]] = field(default_factory=list)


def read_member(file: BinaryIO, clip: TarClip, name: str) -> bytes:
    """Content of one member of an open shard."""
    start, size = clip.members[name]
    file.seek(start)
    return file.read(size)


def check_clip(
    file: BinaryIO, path: Path, clip: TarClip, shard: ShardInfo, layout: MotionLayout
) -> CheckedClip:
    """Read one clip of an open shard. Raises `UserError` or `ValueError` at the first thing wrong."""
    meta = meta_from_json(read_member(file, clip, "meta.json"), f"{path}: '{clip.key}.meta.json'")
    stated = (meta.layout, meta.family, meta.fps, meta.skeleton, meta.split)
    wanted = (layout.name, layout.family, layout.fps, layout.skeleton_name, shard.split)
    if stated != wanted:
        raise ValueError(f"meta.json says layout, family, fps, skeleton, split = {stated}, not {wanted}")
    motion = npy_from_bytes(read_member(file, clip, "motion.npy"), f"{path}: '{clip.key}.motion.npy'")
    if motion.shape != (meta.frames, layout.dim) or not len(motion):
        raise ValueError(f"motion.npy is {list(motion.shape)}, wanted {[meta.frames, layout.dim]}")
    require_finite("motion.npy", motion)
    oddities: list[tuple[str, str]] = []
    if strange := odd_value(motion, layout):
        oddities.append(("beyond what a person can do", f"motion.npy: {strange}"))
    captioned = False
    for name in ("texts.json", "face_texts.json"):
        if name in clip.members:
            found = captions_from_json(read_member(file, clip, name), f"{path}: '{clip.key}.{name}'")
            captioned |= name == "texts.json" and bool(found)
            oddities += _check_captions(name, found, meta.frames / layout.fps)
    if not captioned:
        oddities.append(("no captions", "no captions"))
    if not meta.licence.strip():
        oddities.append(("no licence", "meta.json states no licence"))
    return CheckedClip(meta, motion, _check_audio(file, path, clip), oddities)


def check_value(where: str, raw: bytes, seconds: float) -> Iterator[tuple[str, str]]:
    """The same of a column's value, captions or an array; one without rows stands for none."""
    if where.endswith(".json"):
        yield from _check_captions(where, captions_from_json(raw, where), seconds)
    elif (values := npy_from_bytes(raw, where)).size:
        require_sensible(where, values.reshape(len(values), -1))


def _check_captions(name: str, captions: list[Caption], seconds: float) -> Iterator[tuple[str, str]]:
    """Raises for captions nobody can train on; yields those that reach past the clip."""
    for number, caption in enumerate(captions, start=1):
        where = f"{name}: caption {number}"
        if not caption.text.strip():
            raise ValueError(f"{where} is empty")
        if caption.start >= seconds:
            raise ValueError(f"{where} starts at {caption.start:g} s, the clip ends at {seconds:.2f} s")
        end = seconds if caption.end is None else caption.end
        if not (np.isfinite(caption.start) and np.isfinite(end)) or caption.start < 0:
            raise ValueError(f"{where} has the times {caption.start} to {end}")
        if end <= caption.start:
            raise ValueError(f"{where} ends at {end:g} s, not after its start at {caption.start:g} s")
        if end > seconds + END_TOLERANCE:
            yield "captions past the clip", f"{where} ends at {end:g} s, the clip at {seconds:.2f} s"


def _check_audio(file: BinaryIO, path: Path, clip: TarClip) -> int | None:
    """Width of the audio features, if any; raises when features or sound cannot be used."""
    if "audio.flac" in clip.members:
        _check_sound(read_member(file, clip, "audio.flac"))
    if "audio.npy" not in clip.members:
        return None
    audio = npy_from_bytes(read_member(file, clip, "audio.npy"), f"{path}: '{clip.key}.audio.npy'")
    if audio.ndim != 2 or not len(audio):
        raise ValueError(f"audio.npy is {list(audio.shape)}, not [T_audio >= 1, features]")
    require_sensible("audio.npy", audio)
    return int(audio.shape[1])


def _check_sound(raw: bytes) -> None:
    import soundfile  # only data with sound pays for the import

    try:
        info = soundfile.info(io.BytesIO(raw))
    except soundfile.LibsndfileError as error:
        raise ValueError(f"audio.flac: not readable sound ({error})") from None
    if info.frames < 1 or info.channels != 1:
        raise ValueError(f"audio.flac: {info.frames} samples in {info.channels} channels, wanted mono sound")
