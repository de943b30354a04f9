"""Parts of sound files by name: `song.mp3@0:30-1:00`, `song.mp3@45-`, `song.mp3@-1:20`.

Times are seconds, m:ss or h:mm:ss. A file that is called just so, with its '@', is taken whole.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from motionloom.datasets.schema import UserError

_PART = re.compile(r"(?P<file>.+)@(?P<start>[\d:.]*)(?P<dash>[-\u2013]?)(?P<end>[\d:.]*)", re.DOTALL)
_TIME = re.compile(r"(?:(?:(\d+):)?(\d+):)?(\d+(?:\.\d*)?)")

_BEYOND = 0.5
"""Seconds that the end may lie after that of the sound."""


@dataclass(frozen=True)
class Excerpt:
    """A sound file and what is taken of it."""

    path: Path
    start: float = 0.0
    """Second where it begins."""
    end: float | None = None
    """Second where it ends; None is the end of the file."""

    @classmethod
    def named(cls, name: Path | str) -> Excerpt:
        """Parse a name; `UserError`, naming it, for times that are none."""
        whole, found = Path(name), _PART.fullmatch(str(name))
        if found is None or whole.exists():
            return cls(whole)
        file, start, dash, end = found.group("file", "start", "dash", "end")
        if not dash or not (start or end):
            raise UserError(f"{name}: no such file; a part of {file} is written {Path(file).name}@0:30-1:00")
        first, last = _seconds(start or "0", name), None if not end else _seconds(end, name)
        if last is not None and last <= first:
            raise UserError(f"{name}: its end, {end}, is not after its start, {start}; swap them")
        return cls(Path(file), first, last)

    @property
    def whole(self) -> bool:
        return not self.start and self.end is None

    def within(self, seconds: float, name: Path | str) -> tuple[float, float]:
        """Start and end in a sound so long; `UserError`, naming it `name`, where it is shorter."""
        if self.start >= seconds or (self.end is not None and self.end > seconds + _BEYOND):
            asked = f"{self.start:g} s to {'its end' if self.end is None else f'{self.end:g} s'}"
            raise UserError(f"{name} is {seconds:.1f} s long and {asked} was asked for; shorten it")
        return self.start, seconds if self.end is None else min(self.end, seconds)


def _seconds(time: str, name: Path | str) -> float:
    found = _TIME.fullmatch(time)
    hours, minutes, seconds = (float(part or 0) for part in found.groups()) if found else (0.0, 0.0, 60.0)
    if found is None or (":" in time and seconds >= 60) or (hours and minutes >= 60):
        raise UserError(f"{name}: {time} is no time; write seconds or m:ss, as song.mp3@0:30-1:00")
    return 3600 * hours + 60 * minutes + seconds
