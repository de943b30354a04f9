"""`Sample`: a clip from a converter, and its encoding as WebDataset members.

| member            | content |
|-------------------|---------|
| `motion.npy`      | [T, D] float32 (or float16), C order, features in the dataset's layout |
| `texts.json`      | list of `Caption`; absent when there are none |
| `face_texts.json` | list of `Caption` about the face; absent when there are none |
| `audio.npy`       | [T_audio, 438] float32 audio features |
| `audio.flac`      | the sound itself, mono, 16 bit |
| `meta.json`       | `ClipMeta` |
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import parse_json
from motionloom.datasets.base.records import Caption, ClipMeta, MotionType, Split
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.datasets.motion.layout import MotionLayout

_OURS = ("audio.flac", "audio.npy", "face_texts.json", "meta.json", "motion.npy", "texts.json")
MEMBERS = list(_OURS)
"""Every member name a sample may have: columns of an index, those of further modalities last."""
MODALITIES.follow(lambda record: MEMBERS.extend(m for m in record.members if m not in MEMBERS))


class DropClip(Exception):  # noqa: N818 (a decision, not an error)
    """Raised by a converter to leave a clip out on purpose; its text is the reason kept in the manifest."""


@dataclass(frozen=True)
class Sample:
    """One clip, before it has a key. `motion` is [T, D]; `wav` is (mono samples in [-1, 1], rate in Hz)."""

    meta: ClipMeta
    motion: NDArray[np.float32]
    texts: list[Caption] = field(default_factory=list)
    face_texts: list[Caption] = field(default_factory=list)
    audio: NDArray[np.float32] | None = None
    wav: tuple[NDArray[np.float32], int] | None = None
    arrays: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    """Features [T, E] of further modalities, by member name."""


def encode_sample(
    sample: Sample, *, split: Split, layout: MotionLayout, motion_type: MotionType
) -> dict[str, bytes]:
    """Return bytes by member name; `split` and `frames` of the metadata are set here.

    Raises `ValueError` when the arrays or the metadata do not fit the layout or hold NaN or infinity.
    """
    motion = np.asarray(sample.motion)
    if motion.ndim != 2 or motion.shape[1] != layout.dim or motion.shape[0] < 1:
        raise ValueError(f"motion is {list(motion.shape)}, layout {layout.name} wants [T >= 1, {layout.dim}]")
    with np.errstate(over="ignore"):  # what float16 cannot hold becomes infinite and is refused below
        stored = np.ascontiguousarray(motion, dtype=motion_type)
    require_finite("motion", stored)
    meta = sample.meta
    stated = (meta.layout, meta.family, meta.fps, meta.skeleton)
    wanted = (layout.name, layout.family, layout.fps, layout.skeleton_name)
    if stated != wanted:
        raise ValueError(f"metadata says layout, family, fps, skeleton = {stated}, the dataset is {wanted}")
    # Split and length are facts of the set and the array; a converter cannot state them wrongly.
    meta = meta.model_copy(update={"split": split, "frames": len(motion)})
    members = {"meta.json": json_bytes(meta.dump()), "motion.npy": npy_bytes(stored)}
    if sample.texts:
        members["texts.json"] = json_bytes([caption.dump() for caption in sample.texts])
    if sample.face_texts:
        members["face_texts.json"] = json_bytes([caption.dump() for caption in sample.face_texts])
    if sample.audio is not None:
        audio = np.ascontiguousarray(sample.audio, dtype=np.float32)
        if audio.ndim != 2:
            raise ValueError(f"audio features are {list(audio.shape)}, not [T_audio, features]")
        require_finite("audio features", audio)
        members["audio.npy"] = npy_bytes(audio)
    for name, values in sample.arrays.items():
        require_finite(name, values)
        members[name] = npy_bytes(np.ascontiguousarray(values, dtype=np.float32))
    if sample.wav is not None:
        members["audio.flac"] = flac_bytes(*sample.wav)
    return members


def require_finite(what: str, values: NDArray[np.floating]) -> None:
    """`ValueError` naming the first row that holds NaN or infinity."""
    bad = ~np.isfinite(values).all(axis=-1)
    if bad.any():
        raise ValueError(f"{what}: NaN or infinity in row {int(bad.argmax())}")


def json_bytes(data: object) -> bytes:
    """Compact UTF-8 JSON; the same data gives the same bytes."""
    return json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()


def npy_bytes(values: NDArray[np.generic]) -> bytes:
    """`values` as an .npy file."""
    buffer = io.BytesIO()
    np.save(buffer, values, allow_pickle=False)
    return buffer.getvalue()


def flac_bytes(signal: NDArray[np.float32], rate: int) -> bytes:
    """Mono sound as 16-bit FLAC. (Float WAV would carry a time stamp and differ from run to run.)"""
    import soundfile  # only data with sound pays for the import

    signal = np.asarray(signal, dtype=np.float32)
    if signal.ndim != 1:
        raise ValueError(f"wav is {list(signal.shape)}, not mono [samples]")
    require_finite("wav", signal[:, None])
    buffer = io.BytesIO()
    soundfile.write(buffer, np.clip(signal, -1.0, 1.0), rate, format="FLAC", subtype="PCM_16")
    return buffer.getvalue()


def meta_from_json(raw: bytes, where: str) -> ClipMeta:
    """The metadata of a `meta.json` member; `UserError` naming `where` otherwise."""
    return ClipMeta.parse(parse_json(raw, where), where)


def captions_from_json(raw: bytes, where: str) -> list[Caption]:
    """The captions of a `texts.json` member; `UserError` naming `where` otherwise."""
    data = parse_json(raw, where)
    if not isinstance(data, Sequence) or isinstance(data, str):
        raise UserError(f"{where}: expected a list of captions")
    return [Caption.parse(item, where) for item in data]
