"""What is asked of a server, and the answers: plain JSON, the viewer's data, or a file."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.outputs import file_stem
from motionloom.pipeline.inference.pretrained import MotionModel
from motionloom.pipeline.inference.saving import cell_of
from motionloom.pipeline.inference.stream_lines import frame_lines, heading, rounded
from motionloom.pipeline.inference.streaming import MotionStream
from motionloom.pipeline.render.viewer import viewer_data
from motionloom.pipeline.serve.config import ServeConfig

FILES = {
    "npz": "application/octet-stream",
    "bvh": "text/plain; charset=utf-8",
    "glb": "model/gltf-binary",
    "html": "text/html; charset=utf-8",
}


class MotionRequest(Config):
    """One motion, as a client asks for it."""

    caption: str = ""
    """What the person does."""
    face: str = ""
    """What the face does; as `caption` where it is empty."""
    sound: str | None = Field(None, max_length=64)
    """Name of a sound that was sent before."""
    seconds: float | None = Field(None, gt=0, allow_inf_nan=False)
    """Length; without it the model decides, or the sound."""
    seed: int = Field(0, ge=0, lt=2**63)
    cfg_scale: float = Field(1.0, ge=1, le=20, allow_inf_nan=False)
    temperature: float = Field(1.0, ge=0, le=10, allow_inf_nan=False)
    top_p: float = Field(0.95, gt=0, le=1)
    format: Literal["joints", "viewer", "npz", "bvh", "glb", "html"] = "joints"
    """Numbers, the viewer's data, or a file."""
    request: str = Field("", max_length=64)
    """A name for the answer to bear; made up where it is empty."""

    def require_within(self, limits: ServeConfig, model: MotionModel) -> None:
        """Refuse what is too much; `UserError` in one sentence."""
        for name in ("caption", "face"):
            length = len(getattr(self, name))
            if length > limits.max_caption:
                raise UserError(
                    f"{name} has {length} letters; this server takes at most {limits.max_caption}"
                )
        if self.seconds is not None and self.seconds > limits.max_seconds:
            raise UserError(
                f"{self.seconds:g} s were asked for; this server makes at most {limits.max_seconds:g} s"
            )
        if not self.caption.strip() and self.sound is None:
            raise UserError("caption is empty; say what the person does")
        if self.face and not model.bundle.faces:
            raise UserError("this model makes no face; leave face out")

    @property
    def captions(self) -> list[str]:
        """The caption, where there is one."""
        return [self.caption] if self.caption.strip() else []

    @property
    def faces(self) -> list[str]:
        """The face's caption, where there is one."""
        return [self.face] if self.face else []

    @property
    def sampling(self) -> SamplingConfig:
        """How to draw; only what was asked for counts as set."""
        names = {"cfg_scale", "temperature", "top_p"} & self.model_fields_set
        return SamplingConfig.parse({name: getattr(self, name) for name in names}, "request")


@dataclass(frozen=True)
class Answer:
    """Bytes of a kind, and a name where they are a file."""

    body: bytes
    kind: str
    file: str = ""


def notes_of(model: MotionModel, asked: MotionRequest) -> list[str]:
    """What a person should know of the motion: captions that are unlike all that the model knows."""
    return [str(unknown) for unknown in model.unknown(asked.captions, asked.faces)]


def make(model: MotionModel, asked: MotionRequest, sound: Sound | None, limits: ServeConfig) -> Answer:
    """The motion that is asked for, in its format."""
    seconds = asked.seconds
    if sound is not None:
        longest = min(sound.seconds, limits.max_seconds)
        seconds = longest if seconds is None else seconds
        if seconds > sound.seconds + 0.5:
            raise UserError(f"{seconds:g} s were asked for and the sound lasts {sound.seconds:.1f} s")
        sound = sound.slice(0.0, min(seconds, sound.seconds))
    motion = model.generate(
        asked.captions or None,
        face=asked.faces or None,
        sounds=None if sound is None else [sound],
        seconds=seconds,
        seed=asked.seed,
        sampling=asked.sampling,
    )[0]
    if asked.format in FILES:
        return _file(motion, asked)
    facts = {**_facts(motion, asked), "notes": notes_of(model, asked)}
    if asked.format == "viewer":
        facts["viewer"] = viewer_data([cell_of(motion)])
    else:
        facts |= {
            "joint_names": list(motion.joint_names),
            "parents": [int(parent) for parent in motion.layout.skeleton.parents],
            "joints": rounded(motion.joints),
            "face_values": None if motion.face is None else rounded(motion.face),
        }
    return Answer(json.dumps(facts, separators=(",", ":"), allow_nan=False).encode(), "application/json")


def stream(
    model: MotionModel, asked: MotionRequest, sound: Sound | None, limits: ServeConfig
) -> MotionStream:
    """The stream that is asked for, at most as long as the server allows."""
    seconds = asked.seconds or (
        limits.max_seconds if sound is None else min(sound.seconds, limits.max_seconds)
    )
    caption = asked.caption if asked.caption.strip() else None
    return model.stream(
        caption, face=asked.face, sound=sound, seconds=seconds, seed=asked.seed, sampling=asked.sampling
    )


def lines(stream: MotionStream, asked: MotionRequest, model: str, notes: Sequence[str] = ()) -> Iterator[str]:
    """JSON lines of a stream, whose first one names the request and says what there is to note."""
    facts = json.loads(heading(stream.layout, asked.seed, model))
    yield json.dumps({"request": asked.request, **facts, "notes": list(notes)}) + "\n"
    for chunk in stream:
        yield "".join(frame_lines(chunk))


def _facts(motion: GeneratedMotion, asked: MotionRequest) -> dict[str, Any]:
    return {
        "request": asked.request,
        "caption": motion.caption,
        "face": asked.face,
        "seed": asked.seed,
        "fps": motion.fps,
        "frames": len(motion.joints),
        "seconds": motion.seconds,
    }


def _file(motion: GeneratedMotion, asked: MotionRequest) -> Answer:
    with tempfile.TemporaryDirectory(prefix="motionloom-") as folder:
        path = motion.save(Path(folder) / f"motion.{asked.format}")
        body = path.read_bytes()
    return Answer(body, FILES[asked.format], f"{file_stem(asked.seed, motion.caption)}.{asked.format}")
