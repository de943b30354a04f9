"""Driving scripts: one motion driven by text, by music and by both in turn (UDE section 4.4).

    # show.yaml
    segments:
      - {text: a person walks forward, seconds: 4}
      - {music: song.ogg, start: 30, end: 42}
      - {text: a person waves with the right hand, seconds: 3}

`music` is a file beside the script, of any rate and length; `song.ogg@0:30-0:42` is another way to say start
and end. `text` beside `music` drives the segment by both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from motionloom.datasets.audio.sound import Excerpt, Sound
from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.contract.generation import MotionGenerator, Prompt
from motionloom.pipeline.store.yaml import read_yaml


class ScriptSegment(Config):
    """One entry of a script."""

    text: str = ""
    """Describes the motion."""
    face: str = ""
    """Describes the face; empty takes `text`."""
    music: str | None = None
    """A sound file, seen from the script's folder."""
    seconds: float | None = Field(None, gt=0, allow_inf_nan=False)
    """Length of the segment; of one with music the length from `start` on, as far as the file goes."""
    start: float = Field(0.0, ge=0, allow_inf_nan=False)
    """Second of the music where the segment begins."""
    end: float | None = Field(None, gt=0, allow_inf_nan=False)
    """Second of the music where it ends."""

    @model_validator(mode="after")
    def _one_way(self) -> ScriptSegment:
        if not self.text.strip() and self.music is None:
            raise ValueError("a segment needs text, music or both")
        if self.music is None:
            if self.end is not None or self.start:
                raise ValueError("start and end are seconds of the music; of text give seconds")
            if self.seconds is None:
                raise ValueError("a segment of text needs its length: seconds: 4")
        elif self.end is not None and self.seconds is not None:
            raise ValueError("give seconds or end, not both")
        elif self.end is not None and self.end <= self.start:
            raise ValueError(f"end {self.end:g} is not after start {self.start:g}")
        return self

    def excerpt(self, file: Path, where: str) -> Excerpt:
        """The part of the music that it asks for; `file` may name one itself, `where` is for errors."""
        named = Excerpt.named(file)
        if named.whole:
            end = self.start + self.seconds if self.seconds is not None else self.end
            return replace(named, start=self.start, end=end)
        if self.start or self.end is not None or (self.seconds is not None and named.end is not None):
            raise UserError(f"{where}: {self.music} says itself which part is meant; leave start and end out")
        return named if self.seconds is None else replace(named, end=named.start + self.seconds)


class Script(Config):
    """A script as its file has it."""

    segments: list[ScriptSegment] = Field(min_length=1)

    @staticmethod
    def read(path: Path) -> list[DrivenSegment]:
        """The segments of a YAML file with their sounds, which lie beside it."""
        data = read_yaml(path)
        if not isinstance(data, dict):
            raise UserError(f"{path}: a script is a mapping with a list 'segments'")
        return Script.parse(data, str(path)).open(path.parent, str(path))

    def open(self, folder: Path = Path(), name: str = "script") -> list[DrivenSegment]:
        """The segments with their sounds; `folder` is where files are looked for, `name` is for errors."""
        sounds: dict[Path, Sound] = {}
        out = []
        for number, segment in enumerate(self.segments):
            if segment.music is None:
                prompt = Prompt(segment.text, segment.face)
                out.append(DrivenSegment(prompt, segment.seconds or 0.0, segment.text))
                continue
            where = f"{name}: segments.{number}"
            part = segment.excerpt(folder / segment.music, where)
            if part.path not in sounds:
                sounds[part.path] = read_music(part.path)
            whole = sounds[part.path]
            sound = whole.slice(*part.within(whole.seconds, f"{where}: {segment.music}"))
            label = " + ".join(filter(None, (segment.text, part.path.stem)))
            out.append(DrivenSegment(Prompt(segment.text, segment.face, sound), sound.seconds, label))
        return out


@dataclass(frozen=True)
class DrivenSegment:
    """A segment ready to drive: what by, how long, and what it is called on the time line."""

    prompt: Prompt
    seconds: float
    label: str


def segment_frames(generator: MotionGenerator, segment: DrivenSegment, number: int) -> int:
    """Length of a segment in frames, in whole units of the generator; `number` is for errors."""
    unit, fps = generator.unit_frames, generator.layout.fps
    units = round(segment.seconds * fps / unit)
    if units < 1:
        raise UserError(
            f"segments.{number} ('{segment.label}') lasts {segment.seconds:g} s; the shortest this "
            f"model makes is {unit / fps:.2g} s"
        )
    return units * unit


def read_music(path: Path) -> Sound:
    """A sound file to drive by, or a part of one (`song.mp3@0:30-1:00`)."""
    if not (file := Excerpt.named(path).path).is_file():
        raise UserError(f"{file}: no such sound file")
    return Sound.read(path)


def sound_of(segments: list[tuple[DrivenSegment, int]], fps: float) -> Sound | None:
    """The sound of a whole motion from (segment, frames): silence where a segment has none."""
    rates = [s.prompt.sound.rate for s, _ in segments if s.prompt.sound is not None]
    if not rates:
        return None
    rate = max(rates)
    pieces: list[NDArray[np.float32]] = []
    for segment, frames in segments:
        count = round(frames / fps * rate)
        piece = np.zeros(count, dtype=np.float32)
        if segment.prompt.sound is not None:
            samples = segment.prompt.sound.resampled(rate).samples[:count]
            piece[: len(samples)] = samples
        pieces.append(piece)
    return Sound(np.concatenate(pieces), rate)
