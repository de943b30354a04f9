"""Editing on the page of `motionloom serve`: motions that it made, and files that are sent to it."""

from __future__ import annotations

import asyncio
from dataclasses import asdict
from importlib import resources
from typing import Annotated

from pydantic import AfterValidator, Field
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import temporary_folder
from motionloom.datasets.base.register import register
from motionloom.pipeline.editing.edit import ABILITY, EditedMotion, original_of
from motionloom.pipeline.editing.frames import edit_frames
from motionloom.pipeline.editing.task import MAX_SPEED, EditTask
from motionloom.pipeline.inference.clip_file import read_clip
from motionloom.pipeline.inference.files.outputs import clip_of
from motionloom.pipeline.inference.files.writers import cell_of
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.render.viewer import viewer_data
from motionloom.pipeline.serve.part import Host, OpenPart, ServedPart
from motionloom.pipeline.serve.requests import (
    Answer,
    Asked,
    ServeConfig,
    answer,
    known_answer,
    name_of,
    name_of_facts,
)

CLIP = "the clip"
_KINDS = {b"PK": ".npz", b"glTF": ".glb"}
"""First bytes and the file's ending; what begins otherwise is tried as BVH."""


_HEAD = 4096
"""Bytes at the beginning of a BVH within which its first word stands."""


class ChangeRequest(Asked):
    """A clip, and what is to change of it."""

    clip: str = Field(max_length=64)
    """The name of a clip that was sent or made before."""
    task: EditTask
    seed: int = Field(0, ge=0, lt=2**63)
    format: Annotated[str, AfterValidator(known_answer)] = "joints"
    """As of `MotionRequest`; the viewer's data hold the clip and the result."""

    def require_within(self, limits: ServeConfig, model: MotionModel) -> None:
        model.ability(ABILITY)
        limits.require_small([self.task.caption], self.task.lead + (self.task.seconds or 0.0))


class Clips:
    """The clips of a server, among its motions, and what is made of them."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._model = host.model
        self._config = host.config
        self.kept = host.motions.kept

    async def post_clip(self, http: Request) -> Response:
        """Keep the motion file that the body is, under a name for later requests."""
        self._model.ability(ABILITY)
        async with self._host.upload(http, CLIP, self._config.max_clip_mb) as data:
            return JSONResponse(await asyncio.to_thread(self.add, data))

    async def post_edit(self, http: Request) -> Response:
        """A clip of which a part is made anew."""
        request = await self._host.read(http, ChangeRequest)
        return await self._host.respond(lambda: self.change(request))

    def add(self, data: bytes) -> dict[str, object]:
        """Read a file's bytes and keep the clip at the model's frame rate; the answer about it.

        `UserError` for what is no clip of a person, or too long.
        """
        if not data:
            raise UserError(f"{CLIP}: empty (0 bytes)")
        kind = next((ending for first, ending in _KINDS.items() if data.startswith(first)), ".bvh")
        if kind == ".bvh" and b"HIERARCHY" not in data[:_HEAD].replace(b"\0", b"").upper():
            raise UserError(f"{CLIP}: no motion; send a BVH, a GLB, or an npz that was made here")
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

    def change(self, asked: ChangeRequest) -> Answer:
        """The result that is asked for, made once too."""
        motion = self.kept.get(asked.clip)
        self._config.require_small([""], motion.seconds * asked.task.repeat / asked.task.speed)
        name = name_of_facts({"clip": asked.clip, "task": asked.task.dump(), "seed": asked.seed})
        made = self.kept.made(name, lambda: self._model.edit(motion, asked.task, seed=asked.seed)[0])
        assert isinstance(made, EditedMotion)
        # JSON knows no NaN, which stands for what a task does not ask.
        report = {key: None if value != value else value for key, value in asdict(made.report).items()}
        cells = {"before": made.original, "after": made}
        lines = made.report.lines()
        facts = {"clip": name, "seed": asked.seed, "notes": list(made.remarks)}
        facts |= {"report": report, "lines": lines}
        return answer(made, asked.format, facts, "\n".join(lines), cells, self._config.figure)


def _open(host: Host) -> OpenPart:
    """Editing by a server's model; of one that cannot edit, why."""
    clips = Clips(host)
    why = ""
    try:
        host.model.ability(ABILITY)
    except UserError as error:
        why = str(error)
    posts = {"/api/clips": clips.post_clip, "/api/edit": clips.post_edit}
    return OpenPart(posts, {"possible": not why, "why": why, "max_speed": MAX_SPEED})


register(ServedPart(ABILITY, resources.files("motionloom.pipeline.editing") / "web", _open))
