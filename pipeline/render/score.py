"""What the time line shows besides time: beats as ticks, and the segments of a driving script as bands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypedDict, get_args

import numpy as np

from motionloom.datasets.schema import UserError
from motionloom.pipeline.render.sound import Soundtrack

Driver = Literal["text", "music"]


class Segment(NamedTuple):
    """A stretch of a motion in seconds and what drives it: words, or the name of the music."""

    start: float
    end: float
    label: str
    kind: Driver = "text"


Segments = Sequence[Segment | tuple[float, float, str]]
"""Plain triples are text segments."""


@dataclass(frozen=True)
class Score:
    """What goes with one motion on its time line; everything in seconds from frame 0."""

    sound: Soundtrack | None = None
    beats: Sequence[float] = ()
    segments: Segments = ()


class ScoreData(TypedDict):
    """Beats in seconds; segments [start, end, label, kind]."""

    beats: list[float]
    segments: list[tuple[float, float, str, str]]


def score_data(beats: Sequence[float], segments: Segments, seconds: float, where: str) -> ScoreData:
    """Beats and segments as plain JSON types, those past `seconds` left out; `UserError` names `where`."""
    times = np.asarray(beats, np.float64)
    if times.ndim != 1 or not np.isfinite(times).all():
        raise UserError(f"{where}: beats must be a list of finite seconds, got shape {list(times.shape)}")
    bands: list[tuple[float, float, str, str]] = []
    for segment in (Segment(*s) for s in segments):
        named = f"{where}: segment '{segment.label}'"
        if not (np.isfinite([segment.start, segment.end]).all() and 0 <= segment.start < segment.end):
            raise UserError(f"{named} must start at 0 s or later and end after it starts, got {segment[:2]}")
        if segment.kind not in get_args(Driver):
            raise UserError(f"{named} is of kind '{segment.kind}'; known: {', '.join(get_args(Driver))}")
        if segment.start < seconds:
            end = min(float(segment.end), seconds)
            bands.append((float(segment.start), end, segment.label, segment.kind))
    inside = np.unique(times[(times >= 0) & (times <= seconds)])
    return {"beats": [round(float(t), 4) for t in inside], "segments": bands}
