"""`EditFrames`: a task in frames, as generators take it.

Clips of other proportions than the layout's figure are posed on that figure for the model, and what it makes
is put back on the clip's bones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.convert.common.features import frames_after
from motionloom.datasets.motion.body.resting_hands import with_resting_hands
from motionloom.datasets.motion.body.rigid import RigidMotion, at_rate, fit_rigid, moved
from motionloom.datasets.motion.bvh.own_file import between_rows
from motionloom.datasets.motion.canonical import (
    canonicalize,
    facing,
    ground,
    require_rate,
    resample,
    retarget,
    runs,
)
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.features.torch_joints import torch_way
from motionloom.datasets.motion.layout import (
    BODY_JOINTS,
    LOWER,
    PIECES,
    MotionLayout,
    piece_columns,
    piece_joints,
    pieces_of,
    step_columns,
)
from motionloom.models.diffusion.observed import Places
from motionloom.pipeline.contract.editing import MAX_SPEED, EditTask
from motionloom.pipeline.inference.edits.recorded import RecordedClip

WALKS = 0.3
"""Metres a second of the root above which the figure should face where it goes [ours]."""
_TURNS = 0.5
"""Seconds beside kept frames in which it may turn there [ours]."""
_WRISTS = ("left_wrist", "right_wrist")


@dataclass(frozen=True)
class RootPath:
    """Where the root is in each of T frames, on the floor."""

    heading: NDArray[np.float64]
    """Radians [T]."""
    place: NDArray[np.complex128]
    """Metres [T], z + i x."""


@dataclass(frozen=True)
class EditFrames:
    """A task in frames: T frames of a result, n of them the clip's.

    All positions are seen from the clip's first frame: its root above the origin, facing +Z, the floor at
    height 0. `features` and `places` are on the model's figure, the rest in the clip's size.
    """

    task: EditTask
    layout: MotionLayout
    lead: int
    """Frames before the clip's first."""
    figure: RigidMotion
    """The clip's, n frames on its own bones."""
    face: NDArray[np.float32] | None
    """The clip's [n, 50]."""
    clip_root: RootPath
    """The clip's, n frames."""
    features: NDArray[np.float32]
    """[T, D]: the clip's, held before and after it."""
    pieces: NDArray[np.bool_]
    """Which `layout.PIECES` are kept [T, P]."""
    anchor: RootPath
    """The anchor frame: the one that `places` are seen from."""
    places: Places
    """Known values of the root, one row."""
    path: NDArray[np.complex128]
    """Where the root must be [T], z + i x; NaN elsewhere."""
    pins: dict[tuple[int, int], tuple[float, float, float]]
    """Where joints must be, by frame and joint."""
    scale: float
    """Size of the model's figure in that of the clip's."""
    lift: float
    """By how much the model's figure, in the clip's size, stands too low for the clip's feet, in metres."""
    origin: complex
    """Where the clip's first root is in the clip's world, z + i x."""
    turn: float
    """The heading of the clip's first root there, in radians."""
    height: float
    """Height of the floor there, which is 0 unless the clip is a figure of ours."""
    drawn: bool
    """Whether it is one."""
    seen: NDArray[np.float64]
    """The clip's joints as its file has them [n, M, 3], in the clip's world."""
    base: float
    """Height in that file of what a task calls 0."""
    bare_wrists: tuple[int, ...]
    """Wrists of a clip without fingers, where the model makes these."""
    remarks: tuple[str, ...]

    @property
    def frames(self) -> int:
        return len(self.pieces)

    @property
    def inside(self) -> slice:
        """The clip's frames among those of the result."""
        return slice(self.lead, self.lead + len(self.figure.root))

    @property
    def rooted(self) -> NDArray[np.bool_]:
        """Frames whose root is kept [T]."""
        return self.pieces[:, LOWER]

    @property
    def stretches(self) -> list[tuple[int, int]]:
        """First frame and end of each stretch of which not all of the body is kept."""
        body = self.pieces[:, np.unique(piece_joints(self.layout))]
        return runs(np.any(~body, axis=1))

    @property
    def kept_joints(self) -> NDArray[np.bool_]:
        """Joints that stay where they are in the world [T, N]."""
        kept: NDArray[np.bool_] = self.pieces[:, piece_joints(self.layout)] & self.rooted[:, None]
        return kept

    def to_world(self, figure: RigidMotion) -> RigidMotion:
        """A figure in the clip's world."""
        return moved(figure, self.turn, self.origin, self.height)

    def rows(self, fps: float) -> NDArray[np.float64]:
        """Places [T] of the result's frames among the rows of a file of it."""
        first = round(self.lead / self.layout.fps * fps)
        at = (np.arange(self.frames) - self.lead) / self.layout.fps * fps + first
        return np.asarray(at.round(6))

    def of_file(self, joints: NDArray[np.floating], fps: float) -> NDArray[np.float64]:
        """Joints [R, M, 3] of a file of the result, in the result's frames [T, M, 3]."""
        return between_rows(joints, self.rows(fps).clip(0, len(joints) - 1))


def edit_frames(task: EditTask, clip: RecordedClip, layout: MotionLayout) -> EditFrames:
    """The task in frames of a layout. `UserError` where it cannot be done with the clip."""
    require_rate(len(clip.joints), clip.fps, layout.fps)
    remarks = []
    if abs(clip.fps - layout.fps) > 1e-6:
        remarks.append(f"read at {clip.fps:g} frames/s, edited at the model's {layout.fps:g}")
    drawn = clip.figure if clip.joints.shape[1] == layout.num_joints else None
    drawn = None if drawn is None else at_rate(drawn, clip.fps, layout.fps)
    joints = resample(clip.joints, clip.fps, layout.fps) if drawn is None else drawn.joints
    face = None if clip.face is None else resample(clip.face, clip.fps, layout.fps)
    hands = layout.num_joints > BODY_JOINTS
    if not hands:
        joints = joints[:, :BODY_JOINTS]
    elif not clip.has_hands:
        joints = with_resting_hands(joints)
        remarks.append("the clip has no hands, so the model makes them")
    origin, turn = complex(ground(joints[0, 0])), float(facing(joints[:1])[0])
    floor, base, seen = float(joints[..., 1].min()), 0.0, joints
    if drawn is None:
        figure, height = fit_rigid(canonicalize(joints), layout.skeleton), 0.0
        seen = seen - np.array([0.0, floor, 0.0])
    else:
        figure, height = moved(drawn, -turn, -origin * np.exp(-1j * turn), -floor), floor
    if task.changes_clip:
        seen = moved(figure, turn, origin, 0.0).joints
    elif clip.bvh is not None:
        written = clip.bvh.places()
        seen, base = resample(written, clip.bvh.motion.fps, layout.fps), float(written[..., 1].min())
    elif drawn is not None and clip.figure is not None:
        seen = resample(clip.figure.joints, clip.fps, layout.fps)
    own = figure.joints
    # The features must be of the figure that the model knows; `scale` and `lift` lead back to the clip's.
    retargeted = retarget(own, layout.skeleton)
    posed = canonicalize(retargeted)
    scale = float(retargeted[0, 0, 1] / own[0, 0, 1])
    lift = float(retargeted[0, 0, 1] - posed[0, 0, 1]) / scale
    features = encode(posed, layout, face if layout.has("face") else None)
    # Features of steps have one frame less than the joints.
    face = None if face is None else face[: len(features)]
    if layout.has("face") and face is None:
        remarks.append("the clip has no face, so the model makes it")
    lead, clip_frames = round(task.lead * layout.fps), len(features)
    total = lead + (clip_frames if task.seconds is None else max(2, round(task.seconds * layout.fps)))
    # A result that is shorter than the clip takes no notice of what the clip does later.
    features = features[: total - lead]
    rows = slice(len(features))
    figure = RigidMotion(figure.skeleton, figure.rotations[rows], figure.root[rows], own[rows], figure.error)
    heading, x, z = (one.numpy() for one in torch_way(torch.from_numpy(features).double(), layout))
    clip_root = RootPath(heading, (z + 1j * x) / scale)
    timed = _TimedTask(task, layout, lead, total)
    pieces = timed.pieces(len(features)) & _present(clip, layout)
    path = timed.path(origin, turn)
    timed.require_free(path, pieces[:, LOWER], clip_root)
    pins = timed.pins(pieces, origin, turn, height)
    places, anchor = _known_places(
        clip_root, lead, pieces[:, LOWER], path, scale, layout.fps, "backward" in task.caption.lower()
    )
    return EditFrames(
        task=task,
        layout=layout,
        lead=lead,
        figure=figure,
        face=None if face is None else np.asarray(face[rows], np.float32),
        clip_root=clip_root,
        features=_held(features, layout, lead, total),
        pieces=pieces,
        anchor=anchor,
        places=places,
        path=path,
        pins=pins,
        scale=scale,
        lift=lift,
        origin=origin,
        turn=turn,
        height=height,
        drawn=drawn is not None,
        seen=seen[rows],
        base=base,
        bare_wrists=() if clip.has_hands or not hands else tuple(map(layout.skeleton.index, _WRISTS)),
        remarks=tuple(remarks),
    )


def _present(clip: RecordedClip, layout: MotionLayout) -> NDArray[np.bool_]:
    """Pieces [P] that can be kept: fingers and face are made where the clip has none."""
    hands = clip.has_hands or layout.num_joints == BODY_JOINTS
    return np.array([True] * 4 + [hands] * 2 + [clip.face is not None])


MOST_FRAMES = 12_000
"""Of a clip that is edited, at the model's frame rate: ten minutes at 20 a second, in 270 MB."""


def require_work(task: EditTask, clip: RecordedClip, layout: MotionLayout) -> None:
    """Refuse a task that leaves nothing to make, one that takes nothing from the clip, and a clip that is too
    long: by lengths alone, before any frame is made.
    """
    require_rate(len(clip.joints), clip.fps, layout.fps)
    lead, frames = round(task.lead * layout.fps), frames_after(len(clip.joints), clip.fps, layout)
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
    kept = _TimedTask(task, layout, lead, total).pieces(frames) & _present(clip, layout)
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


@dataclass(frozen=True)
class _TimedTask:
    """The times of a task as frames of the result."""

    task: EditTask
    layout: MotionLayout
    lead: int
    frames: int

    def at(self, what: str, seconds: float) -> int:
        """The frame at a time, which the result must have."""
        frame = round(seconds * self.layout.fps) + self.lead
        if not 0 <= frame < self.frames:
            start, end = -self.lead / self.layout.fps, (self.frames - 1 - self.lead) / self.layout.fps
            raise UserError(f"{what} at {seconds:g} s: the result goes from {start:g} s to {end:.2f} s")
        return frame

    def pieces(self, clip_frames: int) -> NDArray[np.bool_]:
        """Mask of the pieces that are kept [T, P]."""
        task, fps = self.task, self.layout.fps
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

    def path(self, origin: complex, turn: float) -> NDArray[np.complex128]:
        """Where the root must be [T]; NaN elsewhere."""
        from scipy.interpolate import PchipInterpolator

        out = np.full(self.frames, np.nan, dtype=np.complex128)
        if not self.task.path:
            return out
        frames = [self.at("path", point.at) for point in self.task.path]
        places = np.array([complex(point.z, point.x) for point in self.task.path])
        places = (places - origin) * np.exp(-1j * turn)
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
        self, pieces: NDArray[np.bool_], origin: complex, turn: float, height: float
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
            place = (complex(z, x) - origin) * np.exp(-1j * turn)
            out[frame, joint] = (float(place.imag), y - height, float(place.real))
        return out


def _known_places(
    clip: RootPath,
    lead: int,
    rooted: NDArray[np.bool_],
    path: NDArray[np.complex128],
    scale: float,
    fps: float,
    backwards: bool,
) -> tuple[Places, RootPath]:
    """Known values of the root, on the model's figure and seen from an anchor; and that anchor's frame, in
    the clip's size.

    The anchor is the first frame whose root is kept. Without one it is where the path begins, and without a
    path the clip's first frame.
    """
    heading, place = np.zeros(len(rooted)), np.zeros(len(rooted), dtype=np.complex128)
    inside = slice(lead, lead + len(clip.heading))
    heading[inside], place[inside] = clip.heading, clip.place
    on_path = ~np.isnan(path)
    place[on_path] = path[on_path]
    heading_known, place_known = rooted.copy(), rooted | on_path
    # Who walks a drawn path faces where it goes, but not at once where something is kept.
    at, way = np.flatnonzero(place_known), np.zeros_like(place)
    if len(at) > 1:
        way[at] = np.gradient(place[at], at) * fps
    walks = on_path & (np.abs(way) > WALKS)
    for frame in np.flatnonzero(rooted):
        walks[max(0, frame - round(_TURNS * fps)) : frame + round(_TURNS * fps) + 1] = False
    heading[walks] = np.angle(way[walks]) + np.pi * backwards
    heading_known |= walks
    if heading_known.any():  # in between it turns evenly
        at = np.flatnonzero(heading_known)
        heading = np.interp(np.arange(len(heading)), at, np.unwrap(heading[at]))
    seen_from = np.flatnonzero(rooted if rooted.any() else on_path).tolist()
    first = seen_from[0] if seen_from else lead
    heading_known[first] = place_known[first] = True
    anchor = RootPath(heading[first : first + 1], place[first : first + 1])
    seen = (place - anchor.place) * np.exp(-1j * anchor.heading) * scale
    known = Places(
        torch.tensor([first]),
        torch.from_numpy(heading - anchor.heading)[None].float(),
        torch.from_numpy(np.stack([seen.real, seen.imag], axis=-1))[None].float(),
        torch.from_numpy(heading_known)[None],
        torch.from_numpy(place_known)[None],
    )
    return known, anchor


def _held(features: NDArray[np.float32], layout: MotionLayout, lead: int, frames: int) -> NDArray[np.float32]:
    """Features [n, D] from frame `lead` on, standing still before and after: [T, D]."""
    at = np.clip(np.arange(frames) - lead, 0, len(features) - 1)
    out = features[at].copy()
    outside = (np.arange(frames) < lead) | (np.arange(frames) >= lead + len(features))
    out[np.ix_(outside, step_columns(layout))] = 0.0
    return out
