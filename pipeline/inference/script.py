"""Driving scripts: one motion driven by text, by music and by both in turn (UDE section 4.4).

    # show.yaml
    segments:
      - {text: a person walks forward, seconds: 4}
      - {music: song.ogg@0:30-0:42}
      - {text: a person waves with the right hand, seconds: 3}

`music` is a file beside the script, of any rate and length, whole or a part by its name; the segment lasts as
long. `text` beside `music` drives it by both.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from motionloom.datasets.audio.given_beats import take_beats
from motionloom.datasets.audio.sound import Excerpt, Sound
from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import is_file
from motionloom.pipeline.contract.generation import MotionGenerator, Prompt
from motionloom.pipeline.render.sound import Segment
from motionloom.pipeline.store.yaml import read_yaml


class ScriptSegment(Config):
    """One entry of a script."""

    text: str = ""
    """Describes the motion."""
    face: str = ""
    """Describes the face; empty takes `text`."""
    music: str | None = None
    """A sound file, seen from the script's folder, or a part of one: `song.ogg@0:30-0:42`."""
    beats: str | None = None
    """The music's beats, where they are not heard right: a file beside the script, `120@0.35`, or `half`,
    `double` or `shift` (`datasets.audio.given_beats`)."""
    seconds: float | None = Field(None, gt=0, le=3600)
    """Length of a segment of text alone."""

    @model_validator(mode="after")
    def _one_way(self) -> ScriptSegment:
        if not self.text.strip() and self.music is None:
            raise ValueError("a segment needs text, music or both")
        if self.music is None and self.seconds is None:
            raise ValueError("a segment of text needs its length: seconds: 4")
        if self.music is not None and self.seconds is not None:
            raise ValueError("music says itself how long it lasts: leave seconds out, name a part of it")
        return self


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
            part = Excerpt.named(folder / segment.music)
            if part.path not in sounds:
                sounds[part.path] = read_music(part.path)
            whole = sounds[part.path]
            if segment.beats is not None:
                beside = folder / segment.beats
                said = str(beside) if beside.is_file() else segment.beats
                whole = take_beats(whole, part.path, said)
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

    def band(self, start: float, end: float) -> Segment:
        """The segment on the time line of the whole motion, from one second to another."""
        label = f"{self.label} ({self.prompt.remark})" if self.prompt.remark else self.label
        return Segment(float(start), float(end), label, "text" if self.prompt.sound is None else "music")


def segment_frames(generator: MotionGenerator, segment: DrivenSegment, number: int) -> int:
    """Length of a segment in frames, in whole units of the generator; `number` is for errors."""
    unit = generator.unit_frames
    fps = generator.layout.fps
    units = round(segment.seconds * fps / unit)
    if units < 1:
        raise UserError(
            f"segments.{number} ('{segment.label}') lasts {segment.seconds:g} s; the shortest this "
            f"model makes is {unit / fps:.2g} s"
        )
    return units * unit


def read_music(path: Path, beats: str | None = None) -> Sound:
    """A sound file to drive by, or a part of one (`song.mp3@0:30-1:00`), with beats: those that are said, or
    of a file `song.beats` beside it, or none.
    """
    if not is_file(file := Excerpt.named(path).path):
        raise UserError(f"{file}: no such sound file")
    return take_beats(Sound.read(path), path, beats)


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
