"""Clips that a server changes: motions that it made, and files that are sent to it."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated

from pydantic import AfterValidator, Field

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import temporary_folder
from motionloom.pipeline.contract.editing import EditTask
from motionloom.pipeline.inference.edits.clip_file import read_clip
from motionloom.pipeline.inference.edits.edit import require_editor
from motionloom.pipeline.inference.edits.frames import edit_frames
from motionloom.pipeline.inference.model import MotionModel, original_of
from motionloom.pipeline.inference.motion import EditedMotion, GeneratedMotion
from motionloom.pipeline.inference.outputs import clip_of
from motionloom.pipeline.inference.writers import cell_of
from motionloom.pipeline.render.viewer import viewer_data
from motionloom.pipeline.serve.requests import (
    Answer,
    MotionRequest,
    Recent,
    ServeConfig,
    answer,
    known_answer,
    motion_of,
    name_of,
    notes_of,
)

CLIP = "the clip"
_KINDS = {b"PK": ".npz", b"glTF": ".glb"}
"""First bytes and the file's ending; what begins otherwise is tried as BVH."""


_HEAD = 4096
"""Bytes at the beginning of a BVH within which its first word stands."""


class ChangeRequest(Config):
    """A clip, and what is to change of it."""

    clip: str = Field(max_length=64)
    """The name of a clip that was sent or made before."""
    task: EditTask
    seed: int = Field(0, ge=0, lt=2**63)
    format: Annotated[str, AfterValidator(known_answer)] = "joints"
    """As of `MotionRequest`; the viewer's data hold the clip and the result."""

    def require_within(self, limits: ServeConfig, model: MotionModel) -> None:
        """Refuse what is too much; `UserError` in one sentence."""
        require_editor(model.bundle.generator)
        limits.require_small([self.task.caption], self.task.lead + (self.task.seconds or 0.0))


class Clips:
    """The clips used last, with what was made of them."""

    def __init__(self, model: MotionModel, config: ServeConfig) -> None:
        self._model, self._config = model, config
        self.kept = Recent[GeneratedMotion](config.clips, CLIP)

    def add(self, data: bytes) -> dict[str, object]:
        """Read a file's bytes and keep the clip at the model's frame rate; the answer about it.

        `UserError` for what is no clip of a person, or too long.
        """
        if not data:
            raise UserError(f"{CLIP}: empty (0 bytes)")
        kind = next((ending for first, ending in _KINDS.items() if data.startswith(first)), ".bvh")
        if kind == ".bvh" and b"HIERARCHY" not in data[:_HEAD].replace(b"\0", b"").upper():
            raise UserError(f"{CLIP}: no motion; send a BVH, or a GLB or npz that was made here")
        with temporary_folder() as folder:
            path = folder / f"clip{kind}"
            path.write_bytes(data)
            try:
                clip = read_clip(path)
            except UserError as error:
                raise UserError(str(error).replace(str(path), CLIP)) from None
        if clip.seconds > self._config.max_seconds:
            raise UserError(
                f"{CLIP} lasts {clip.seconds:.0f} s; this server takes at most {self._config.max_seconds:g} s"
            )
        frames = edit_frames(EditTask(), clip, self._model.bundle.layout)
        motion = self.kept.made(name_of(data), lambda: original_of(frames, clip))
        return {
            "clip": name_of(data),
            "caption": motion.caption,
            "fps": motion.fps,
            "frames": len(motion.joints),
            "seconds": motion.seconds,
            "notes": list(frames.remarks),
            "viewer": viewer_data([cell_of(clip_of(motion), CLIP)]),
        }

    def generate(self, asked: MotionRequest, sound: Sound | None) -> Answer:
        """The motion that is asked for. The same request is answered with the same motion, made once."""
        name = _name_of(asked.model_dump(mode="json", exclude={"format"}, exclude_unset=True))
        motion = self.kept.made(name, lambda: motion_of(self._model, asked, sound, self._config))
        notes = notes_of(self._model, asked, sound, motion)
        facts = {"clip": name, "seed": asked.seed, "face": asked.face, **notes}
        return answer(motion, asked.format, facts, "\n".join(notes["notes"]), {"generated": motion})

    def change(self, asked: ChangeRequest) -> Answer:
        """The result that is asked for, made once too."""
        motion = self.kept.get(asked.clip)
        self._config.require_small([""], motion.seconds * asked.task.repeat / asked.task.speed)
        name = _name_of({"clip": asked.clip, "task": asked.task.dump(), "seed": asked.seed})
        made = self.kept.made(name, lambda: self._model.edit(motion, asked.task, seed=asked.seed)[0])
        assert isinstance(made, EditedMotion)
        # JSON knows no NaN, which stands for what a task does not ask.
        report = {key: None if value != value else value for key, value in asdict(made.report).items()}
        cells, lines = {"before": made.original, "after": made}, made.report.lines()
        facts = {"clip": name, "seed": asked.seed, "notes": list(made.remarks)}
        facts |= {"report": report, "lines": lines}
        return answer(made, asked.format, facts, "\n".join(lines), cells)


def _name_of(facts: dict[str, object]) -> str:
    return name_of(json.dumps(facts, sort_keys=True).encode())
