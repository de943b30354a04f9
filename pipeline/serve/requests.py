"""Requests to the server and its answers: plain JSON, the viewer's data, or a file."""

from __future__ import annotations

import hashlib
import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from motionloom.datasets.audio.given_beats import in_words, with_beats
from motionloom.datasets.audio.sound import Sound, read_sound, sound_seconds
from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import temporary_folder
from motionloom.pipeline.inference.files.display_figure import FigureOptions
from motionloom.pipeline.inference.files.outputs import clip_of, file_stem, page_title
from motionloom.pipeline.inference.files.writers import WRITERS, Outputs, cell_of
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.render.viewer import viewer_data
from motionloom.pipeline.store.known_captions import Unknown


class ServeConfig(Config):
    """Where a server listens, and how much it takes on."""

    host: str = "127.0.0.1"
    """Address to listen at; anything but loopback lets others in."""
    port: int = Field(8000, ge=0, le=65535)
    """0 takes a free one."""
    rig: Path | None = None
    """The user's own character, for the formats `rig` and `rig-page`."""
    rig_map: Path | None = None
    """Names of its joints (JSON)."""
    allow_hosts: tuple[str, ...] = ()
    """Names and addresses that the server is reached by, besides localhost and `host`."""
    waiting: int = Field(32, ge=1)
    """Requests that wait for the model; more are refused."""
    max_seconds: float = Field(30.0, gt=0)
    """Longest motion."""
    max_caption: int = Field(300, ge=1)
    """Longest caption, in letters."""
    max_sound_mb: float = Field(20.0, gt=0)
    """Largest sound file."""
    max_sound_seconds: float = Field(300.0, gt=0)
    """Longest sound."""
    sounds: int = Field(4, ge=1)
    """Sounds that are kept; the one used longest ago makes room."""
    max_clip_mb: float = Field(20.0, gt=0)
    """Largest motion file."""
    clips: int = Field(32, ge=1)
    """Clips that are kept, with what was made of them; the one used longest ago makes room."""
    max_request_kb: float = Field(16.0, gt=0)
    """Largest request besides a sound or a clip."""
    patience: float = Field(20.0, gt=0)
    """Seconds in which the headers of a request must have arrived, and then its body."""
    connections: int = Field(256, ge=1)
    """Connections at a time; one more is answered 503."""

    @property
    def figure(self) -> FigureOptions:
        """What figures are written by."""
        return FigureOptions(more=self.model_dump(include={"rig", "rig_map"}, exclude_none=True))

    def require_small(self, texts: Iterable[str], seconds: float) -> None:
        """Refuse captions and a motion that are longer than allowed."""
        length = max(map(len, texts))
        if length > self.max_caption:
            raise UserError(f"a caption has {length} letters; this server takes at most {self.max_caption}")
        if seconds > self.max_seconds:
            raise UserError(f"{seconds:g} s were asked for; this server makes at most {self.max_seconds:g} s")


def known_answer(name: str) -> str:
    """The name of a format that a server gives; ValueError for others."""
    known = ["joints", "viewer", *WRITERS]
    if name not in known:
        raise ValueError(f"no format '{name}'; known: {', '.join(known)}")
    return name


_USUAL = 4.0
"""Seconds of a motion by a model that must be told its length, where nobody tells it."""

_SOUND = "the sound"
_KINDS = {b"RIFF": ".wav", b"RF64": ".wav", b"fLaC": ".flac", b"OggS": ".ogg"}
"""First bytes and the file's ending; what begins otherwise is tried as MP3."""


class Asked(Config):
    """A request as JSON; a subclass has its fields."""

    def require_within(self, limits: ServeConfig, model: MotionModel) -> None:
        """Refuse what is too much; `UserError` in one sentence."""


class MotionRequest(Asked):
    """One motion, as a client asks for it."""

    caption: str = ""
    """Describes the motion."""
    face: str = ""
    """Describes the face; empty takes `caption`."""
    sound: str | None = Field(None, max_length=64)
    """Name of a sound that was sent before."""
    beats: str = Field("", max_length=65_536)
    """The sound's beats, if they are not heard right: seconds, `120@0.35`, or `half`, `double`, `shift`."""
    seconds: float | None = Field(None, gt=0, le=3600)
    """Length; without it the model decides, or the sound, or it is four seconds."""
    seed: int = Field(0, ge=0, lt=2**63)
    cfg_scale: float = Field(1.0, ge=1, le=20)
    temperature: float = Field(1.0, ge=0, le=10)
    top_p: float = Field(0.95, gt=0, le=1)
    format: Annotated[str, AfterValidator(known_answer)] = "joints"
    """Numbers (`joints`), the viewer's data (`viewer`), or a file of a format of `WRITERS`."""

    def require_within(self, limits: ServeConfig, model: MotionModel) -> None:
        limits.require_small([self.caption, self.face], self.seconds or 0.0)
        if not self.caption.strip() and self.sound is None:
            raise UserError("caption is empty; say what the person does")

    def of_model(self, model: MotionModel, sound: Sound | None, limits: ServeConfig) -> Request:
        """The request of a model that this is, with the sound that it names."""
        seconds = self.seconds
        if seconds is None and sound is None and not model.bundle.generator.decides_length:
            seconds = min(_USUAL, limits.max_seconds)
        if sound is not None:
            seconds = min(sound.seconds, limits.max_seconds) if seconds is None else seconds
            if seconds <= sound.seconds:
                sound = sound.slice(0.0, seconds)
        drawn = {"cfg_scale", "temperature", "top_p"} & self.model_fields_set
        return Request.of(
            [self.caption] if self.caption.strip() else None,
            face=[self.face] if self.face else None,
            sounds=None if sound is None else [sound],
            seconds=seconds,
            seed=self.seed,
            sampling={name: getattr(self, name) for name in drawn},
        )


@dataclass(frozen=True)
class Answer:
    """Bytes of a kind, and a name where they are a file."""

    body: bytes
    kind: str
    file: str = ""


class Motions:
    """The motions used last: those that are asked for, and what parts of the server keep."""

    def __init__(self, model: MotionModel, config: ServeConfig) -> None:
        self._model = model
        self._config = config
        self.kept = Recent[GeneratedMotion](config.clips, "the clip")

    def generate(self, asked: MotionRequest, sound: Sound | None) -> Answer:
        """The motion that is asked for. The same request is answered with the same motion, made once."""
        model = self._model
        name = name_of_facts(asked.model_dump(mode="json", exclude={"format"}, exclude_unset=True))
        if sound is not None and asked.beats:
            sound = with_beats(sound, asked.beats)
        request = asked.of_model(model, sound, self._config)
        motion = self.kept.made(name, lambda: model.make(request)[0])
        found = model.notes(request, [motion])
        notes = [one.what if isinstance(one, Unknown) else one for one in found]
        # What could be said of the body instead of a caption that is unlike all that the model knows.
        unknown = (one for one in found if isinstance(one, Unknown) and one.caption == asked.caption)
        nearest = [text for one in unknown for text in one.nearest]
        facts = {"clip": name, "seed": asked.seed, "face": asked.face, "notes": notes, "nearest": nearest}
        if sound is not None:
            facts["heard"] = in_words(sound)
        figure = self._config.figure
        return answer(motion, asked.format, facts, "\n".join(notes), {"generated": motion}, figure)


def answer(
    motion: GeneratedMotion,
    form: str,
    facts: Mapping[str, object],
    note: str,
    cells: Mapping[str, GeneratedMotion],
    figure: FigureOptions,
) -> Answer:
    """A motion as a file of one of `WRITERS`, by `figure`, with the note on its page; else as JSON with
    `facts`: its numbers, or the viewer's data of `cells`, each under its label.
    """
    if form in WRITERS:
        writer = WRITERS[form]
        with temporary_folder() as folder:
            path = folder / f"motion{writer.suffix}"
            clip = replace(clip_of(motion), options=figure)
            writer.write(path, Outputs([clip], page_title([motion.caption]), note))
            name = f"{file_stem(motion.seed or 0, motion.caption)}{writer.suffix}"
            return Answer(path.read_bytes(), writer.mime, name)
    whole = {
        "caption": motion.caption,
        "fps": motion.fps,
        "frames": len(motion.joints),
        "seconds": motion.seconds,
        **facts,
    }
    if form == "viewer":
        whole["viewer"] = viewer_data([cell_of(clip_of(one), label) for label, one in cells.items()])
    else:
        whole |= {
            "joint_names": list(motion.joint_names),
            "parents": [int(parent) for parent in motion.layout.skeleton.parents],
            "joints": _rounded(motion.joints),
            "face_values": None if motion.face is None else _rounded(motion.face),
        }
    return Answer(json.dumps(whole, separators=(",", ":"), allow_nan=False).encode(), "application/json")


def _rounded(values: NDArray[np.floating]) -> object:
    """Numbers as lists, to a hundredth of a millimetre, so that they are short in writing."""
    return np.round(np.asarray(values, np.float64), 5).tolist()


def name_of(data: bytes) -> str:
    """The name under which a client finds what it sent, or what was made of it, again."""
    return hashlib.sha256(data).hexdigest()[:24]


def name_of_facts(facts: Mapping[str, object]) -> str:
    """The name of what is made by these facts."""
    return name_of(json.dumps(facts, sort_keys=True).encode())


T = TypeVar("T")


class Recent(Generic[T]):
    """A cache of the last used, by name, for several threads; messages call them `what`."""

    def __init__(self, most: int, what: str) -> None:
        self._most = most
        self._what = what
        self._kept: OrderedDict[str, T] = OrderedDict()
        self._lock = threading.Lock()

    def made(self, name: str, make: Callable[[], T]) -> T:
        """The value of a name, made where it is not here; what was used longest ago makes room."""
        try:
            return self.get(name)
        except UserError:
            found = make()
        with self._lock:
            self._kept[name] = found
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return found

    def get(self, name: str) -> T:
        """The value, used now; `UserError` where it is not here."""
        with self._lock:
            if name not in self._kept:
                raise UserError(f"{self._what} is not here any more; send it again")
            self._kept.move_to_end(name)
            return self._kept[name]


class Sounds:
    """The sounds used last."""

    def __init__(self, config: ServeConfig) -> None:
        self._config = config
        self.kept = Recent[Sound](config.sounds, _SOUND)
        self._decoding = threading.Lock()

    def add(self, data: bytes) -> tuple[str, Sound]:
        """Decode a file's bytes and keep them; `UserError` for what is no sound or too long."""
        if not data:
            raise UserError(f"{_SOUND}: empty (0 bytes)")
        with self._decoding:  # one at a time: a sound takes several times its file's memory
            return name_of(data), self.kept.made(name_of(data), lambda: self._decode(data))

    def _decode(self, data: bytes) -> Sound:
        longest = self._config.max_sound_seconds
        with temporary_folder() as folder:
            path = folder / f"sound{_KINDS.get(data[:4], '.mp3')}"
            path.write_bytes(data)
            seconds = sound_seconds(path, _SOUND)
            if seconds > longest:
                raise UserError(f"{_SOUND} lasts {seconds:.0f} s; this server takes at most {longest:g} s")
            samples, rate = read_sound(path, _SOUND)
        return Sound(np.clip(samples, -1.0, 1.0), rate)
