"""Beats that somebody gives a piece of music, in place of those that the tracker hears.

They are said as seconds of the file, one a line or a JSON list, as a tempo and the first beat (`120@0.35`),
or as a change of what is heard: `half` and `double` of the tempo, or `shift` by half a beat. A file
`song.beats` beside `song.ogg` is taken where nothing is said.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.sound import Excerpt, Sound
from motionloom.datasets.audio.tracker import UNSURE, track
from motionloom.datasets.base.errors import UserError

Times = NDArray[np.float64]
CHANGES = ("half", "double", "shift")
SUFFIX = ".beats"
SLOWEST, FASTEST = 20.0, 400.0
"""Beats a minute that are taken."""
_PULSE = re.compile(r"(\d+(?:\.\d+)?)@(\d+(?:\.\d+)?)")
_HOW = "write seconds, one a line, or a tempo and the first beat, as 120@0.35, or half, double or shift"


def with_beats(sound: Sound, said: str, name: str = "beats") -> Sound:
    """Return the sound with the beats that are said, seconds of the piece that it is cut from.

    Raises:
        UserError: Naming `name`, where they are none, or not those of this piece.
    """
    piece = sound.piece or sound
    times = _times(piece, said.strip(), name)
    inside = times[(times >= 0.0) & (times < piece.seconds)]
    if len(inside) < 2:
        raise UserError(f"{name}: fewer than two beats within the {piece.seconds:.1f} s of the sound; {_HOW}")
    given = replace(piece, beats=inside, analysed={})
    return given if sound.piece is None else replace(sound, piece=given, analysed={})


def take_beats(sound: Sound, file: Path | str, said: str | None = None) -> Sound:
    """Return the sound of a file with the beats that are said, a file of them too, or those beside it."""
    if said is None:
        beside = Excerpt.named(file).path.with_suffix(SUFFIX)
        said = str(beside) if beside.is_file() else ""
    if not said:
        return sound
    path = Path(said)
    if not path.is_file():
        return with_beats(sound, said, f"beats {said}")
    try:
        return with_beats(sound, path.read_text(encoding="utf-8"), str(path))
    except UnicodeDecodeError:
        raise UserError(f"{path}: no text; {_HOW}") from None


def in_words(sound: Sound) -> str:
    """What is thought of a sound's beats, and how sure it is."""
    piece = sound.piece or sound
    found = track(piece)
    if len(found.times) < 2:
        return "no beat is heard"
    tempo = 60.0 / float(np.median(np.diff(found.times)))
    pulse = f"{tempo:.0f} beats a minute, {found.meter} a bar, one at {found.times[0]:.2f} s"
    if piece.beats is not None:
        return f"{pulse}, as given"
    sure = "sure" if found.confidence >= UNSURE else "unsure"
    return f"{pulse} ({sure}: {found.confidence:.2f} of 1)"


def _times(piece: Sound, said: str, name: str) -> Times:
    """Seconds of the piece's beats, ascending."""
    if said in CHANGES:
        return _changed(track(replace(piece, beats=None)).times, said)
    if (pulse := _PULSE.fullmatch(said)) is not None:
        tempo, first = map(float, pulse.groups())
        if not SLOWEST <= tempo <= FASTEST:
            raise UserError(f"{name}: {tempo:g} is no tempo; give {SLOWEST:g} to {FASTEST:g} beats a minute")
        step = 60.0 / tempo
        return np.arange(first % step, piece.seconds, step)
    try:
        if said[:1] in ("[", "{"):
            data = json.loads(said)
            times = np.array(data["beats"] if isinstance(data, dict) else data, dtype=np.float64)
        else:
            times = np.array(said.replace(",", " ").split(), dtype=np.float64)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        raise UserError(f"{name}: neither a file nor beats; {_HOW}") from None
    steps = np.diff(times)
    if times.ndim != 1 or not np.isfinite(times).all() or (steps <= 0).any():
        raise UserError(f"{name}: beats must be seconds that ascend; {_HOW}")
    if len(steps) and not 60.0 / FASTEST <= float(np.median(steps)) <= 60.0 / SLOWEST:
        raise UserError(
            f"{name}: {60 / np.median(steps):.3g} beats a minute; give {SLOWEST:g} to {FASTEST:g}, in seconds"
        )
    return times


def _changed(times: Times, how: str) -> Times:
    if how == "half" or len(times) < 2:
        return times[::2]
    between = (times[1:] + times[:-1]) / 2
    return between if how == "shift" else np.sort(np.concatenate([times, between]))
