"""The times and places of a task as frames of the result, seen from the clip's first frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.convert.common.features import frames_after
from motionloom.datasets.motion.body.rigid import RigidMotion, moved
from motionloom.datasets.motion.canonical import require_rate
from motionloom.datasets.motion.layout import (
    BODY_JOINTS,
    PIECES,
    MotionLayout,
    piece_columns,
    piece_joints,
    pieces_of,
)
from motionloom.pipeline.editing.task import MAX_SPEED, EditTask
from motionloom.pipeline.inference.clip_file import RecordedClip

MOST_FRAMES = 12_000
"""Of a clip that is edited, at the model's frame rate: ten minutes at 20 a second, in 270 MB."""


@dataclass(frozen=True)
class RootPath:
    """Where the root is in each of T frames, on the floor."""

    heading: NDArray[np.float64]
    """Radians [T]."""
    place: NDArray[np.complex128]
    """Metres [T], z + i x."""


@dataclass(frozen=True)
class World:
    """Where the clip's first frame stands in the clip's world, which is a task's: Y up, metres."""

    origin: complex
    """The root on the floor, z + i x."""
    turn: float
    """Its heading, in radians."""
    height: float
    """Height of the floor, which is 0 unless the clip is a figure of ours."""

    def seen(self, place: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Places of the world, z + i x, as the clip's first frame sees them."""
        return np.asarray((place - self.origin) * np.exp(-1j * self.turn))

    def places(self, seen: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Places, z + i x, that the clip's first frame sees, in the world."""
        return np.asarray(seen * np.exp(1j * self.turn) + self.origin)

    def figure(self, seen: RigidMotion) -> RigidMotion:
        """A figure that the clip's first frame sees, in the world."""
        return moved(seen, self.turn, self.origin, self.height)


@dataclass(frozen=True)
class TimedTask:
    """The times of a task as frames of the result."""

    task: EditTask
    layout: MotionLayout
    lead: int
    frames: int

    def at(self, what: str, seconds: float) -> int:
        """The frame at a time, which the result must have."""
        frame = round(seconds * self.layout.fps) + self.lead
        if not 0 <= frame < self.frames:
            start = -self.lead / self.layout.fps
            end = (self.frames - 1 - self.lead) / self.layout.fps
            raise UserError(f"{what} at {seconds:g} s: the result goes from {start:g} s to {end:.2f} s")
        return frame

    def pieces(self, clip_frames: int) -> NDArray[np.bool_]:
        """Mask of the pieces that are kept [T, P]."""
        task = self.task
        fps = self.layout.fps
        out = np.zeros((self.frames, len(PIECES)), dtype=np.bool_)
        clip_end = self.lead + clip_frames
        for number, kept in enumerate(task.keep or ()):
            start = self.lead + round(kept.start * fps)
            if start >= clip_end:
                raise UserError(
                    f"keep.{number}: it starts at {kept.start:g} s and the clip lasts "
                    f"{clip_frames / fps:.2f} s"
                )
            end = clip_end if kept.end is None else min(clip_end, self.lead + round(kept.end * fps))
            out[start:end] |= pieces_of(kept.parts, kept.but)
        if task.keep is None and (self.frames > clip_frames or task.changes_clip):
            out[self.lead : clip_end] = True
        return out

    def path(self, world: World) -> NDArray[np.complex128]:
        """Where the root must be [T]; NaN elsewhere."""
        from scipy.interpolate import PchipInterpolator

        out = np.full(self.frames, np.nan, dtype=np.complex128)
        if not self.task.path:
            return out
        frames = [self.at("path", point.at) for point in self.task.path]
        places = world.seen(np.array([complex(point.z, point.x) for point in self.task.path]))
        if len(set(frames)) < len(frames):
            raise UserError(f"path: two of its points are in one frame of {1 / self.layout.fps:.3g} s")
        if len(frames) == 1:
            out[frames[0]] = places[0]
            return out
        inside = np.arange(frames[0], frames[-1] + 1)
        out[inside] = PchipInterpolator(frames, places.real)(inside)
        out[inside] += 1j * PchipInterpolator(frames, places.imag)(inside)
        return out

    def require_free(self, path: NDArray[np.complex128], rooted: NDArray[np.bool_], clip: RootPath) -> None:
        """Refuse a path where the root is kept, or that nobody gets to from where it is kept."""
        asked = np.flatnonzero(~np.isnan(path))
        if not len(asked):
            return
        if rooted[asked].any():
            at = (int(asked[rooted[asked]][0]) - self.lead) / self.layout.fps
            raise UserError(f"path: at {at:g} s the legs are kept, and with them where they go")
        known = np.union1d(asked, np.flatnonzero(rooted))
        there = path.copy()
        there[rooted] = clip.place[np.flatnonzero(rooted) - self.lead]
        speeds = np.abs(np.diff(there[known])) / np.diff(known) * self.layout.fps
        speeds[rooted[known[1:]] & rooted[known[:-1]]] = 0  # the clip's own
        if len(speeds) and (fastest := speeds.max()) > MAX_SPEED:
            at = (int(known[speeds.argmax() + 1]) - self.lead) / self.layout.fps
            raise UserError(
                f"path: {fastest:.0f} m/s on the way to {at:g} s; nobody runs faster than {MAX_SPEED:g} m/s, "
                f"give it more time"
            )

    def pins(
        self, pieces: NDArray[np.bool_], world: World
    ) -> dict[tuple[int, int], tuple[float, float, float]]:
        """Pinned joints by frame and joint."""
        out = {}
        for pin in self.task.pins:
            try:
                joint = self.layout.skeleton.index(pin.joint)
            except UserError:
                names = ", ".join(self.layout.skeleton.joints[:BODY_JOINTS])
                raise UserError(f"pins: no joint '{pin.joint}'; there are {names}, and the fingers") from None
            frame = self.at(f"pins: {pin.joint}", pin.at)
            if pieces[frame, piece_joints(self.layout)[joint]]:
                raise UserError(f"pins: {pin.joint} is kept at {pin.at:g} s; keep less, or leave the pin out")
            if (frame, joint) in out:
                raise UserError(f"pins: {pin.joint} is pinned twice in the frame at {pin.at:g} s")
            x, y, z = pin.position
            [place] = world.seen(np.array([complex(z, x)]))
            out[frame, joint] = (float(place.imag), y - world.height, float(place.real))
        return out


def present(clip: RecordedClip) -> NDArray[np.bool_]:
    """Pieces [P] that can be kept: hands that nobody recorded rest, and a face that nobody did is made."""
    return np.array([True] * 6 + [clip.face is not None])


def require_work(task: EditTask, clip: RecordedClip, layout: MotionLayout) -> None:
    """Refuse a task that leaves nothing to make, one that takes nothing from the clip, and a clip that is too
    long: by lengths alone, before any frame is made.
    """
    require_rate(len(clip.joints), clip.fps, layout.fps)
    lead = round(task.lead * layout.fps)
    frames = frames_after(len(clip.joints), clip.fps, layout)
    total = lead + (frames if task.seconds is None else max(2, round(task.seconds * layout.fps)))
    longest = max(total, frames, frames * task.repeat / task.speed)
    if longest > MOST_FRAMES:
        minutes = [count / layout.fps / 60 for count in (longest, MOST_FRAMES)]
        raise UserError(
            f"{clip.name}: {minutes[0]:.1f} min of motion, and at most {minutes[1]:g} min are edited at a "
            f"time; cut the clip, or ask for less"
        )
    if task.changes_clip:
        return
    kept = TimedTask(task, layout, lead, total).pieces(frames) & present(clip)
    if kept[:, np.isin(np.arange(len(PIECES)), piece_columns(layout))].all():
        raise UserError(
            "everything of the clip is kept, so there is nothing to make: keep less of it, or give seconds "
            "or lead for more"
        )
    if not (kept.any() or task.pins or task.path):
        raise UserError(
            "nothing of the clip is kept and nothing else is asked: say what to keep, draw a path, or pin a "
            "joint"
        )
