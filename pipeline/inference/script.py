"""Driving scripts: one motion driven by text, by music and by both in turn (UDE section 4.4).

    # show.yaml
    segments:
      - {text: a person walks forward, seconds: 4}
      - {music: song.ogg, start: 30, end: 42}
      - {text: a person waves with the right hand, seconds: 3}

`music` is a file beside the script, of any rate and length; `text` beside `music` drives the segment by both.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from motionloom.datasets.audio.sound import Sound, require_audible
from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.contract.generation import MotionGenerator, Prompt
from motionloom.pipeline.store.yaml import read_yaml


class ScriptSegment(Config):
    """One entry of a script."""

    text: str = ""
    """What the person does."""
    face: str = ""
    """What the face does; as `text` where it is empty."""
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

    @property
    def label(self) -> str:
        """A few words for the time line."""
        name = Path(self.music).stem if self.music is not None else ""
        return " + ".join(filter(None, (self.text, name)))


class Script(Config):
    """A script as its file has it."""

    segments: list[ScriptSegment] = Field(min_length=1)

    @staticmethod
    def read(path: Path) -> Script:
        """A YAML file; `UserError` names file, key and fix."""
        data = read_yaml(path)
        if not isinstance(data, dict):
            raise UserError(f"{path}: a script is a mapping with a list 'segments'")
        return Script.parse(data, str(path))

    def open(self, folder: Path, name: str = "script") -> list[DrivenSegment]:
        """The segments with their sounds; `folder` is where files are looked for, `name` is for errors."""
        sounds: dict[str, Sound] = {}
        out = []
        for number, segment in enumerate(self.segments):
            if segment.music is None:
                out.append(
                    DrivenSegment(Prompt(segment.text, segment.face), segment.seconds or 0.0, segment.label)
                )
                continue
            if segment.music not in sounds:
                sounds[segment.music] = read_music(folder / segment.music)
            sound = _cut(sounds[segment.music], segment, f"{name}: segments.{number}")
            prompt = Prompt(segment.text, segment.face, sound)
            out.append(DrivenSegment(prompt, sound.seconds, segment.label))
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
    """A sound file to drive by; silence is refused."""
    if not path.is_file():
        raise UserError(f"{path}: no such sound file")
    sound = Sound.read(path)
    require_audible(sound.samples, path)
    return sound


def _cut(sound: Sound, segment: ScriptSegment, where: str) -> Sound:
    end = segment.end
    if end is None and segment.seconds is not None:
        end = segment.start + segment.seconds
    if segment.start >= sound.seconds or (end is not None and end > sound.seconds + 0.5):
        asked = f"{segment.start:g} s to {'its end' if end is None else f'{end:g} s'}"
        raise UserError(
            f"{where}: {segment.music} is {sound.seconds:.1f} s long and {asked} was asked for; shorten it"
        )
    return sound.slice(segment.start, None if end is None else min(end, sound.seconds))


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
