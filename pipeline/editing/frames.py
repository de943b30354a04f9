"""A task in frames: `EditFrames`, in one frame of coordinates, and what a model is given of it,
`KnownFrames`.

Clips of other proportions than the layout's figure are posed on that figure for the model, and what it makes
is put back on the clip's bones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.motion.body.resting_hands import with_resting_hands
from motionloom.datasets.motion.body.retarget import with_hands
from motionloom.datasets.motion.body.rigid import RigidMotion, at_rate, fit_rigid, moved
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
from motionloom.datasets.motion.layout import BODY_JOINTS, LOWER, MotionLayout, piece_joints, step_columns
from motionloom.pipeline.editing.inbetween.observed import Places
from motionloom.pipeline.editing.own_file import between_rows
from motionloom.pipeline.editing.task import EditTask
from motionloom.pipeline.editing.timed import RootPath, TimedTask, World, present
from motionloom.pipeline.inference.clip_file import RecordedClip

WALKS = 0.3
"""Metres a second of the root above which the figure should face where it goes [ours]."""
_TURNS = 0.5
"""Seconds beside kept frames in which it may turn there [ours]."""


@dataclass(frozen=True)
class KnownFrames:
    """What a model is given of a task: T frames on the model's own figure."""

    features: NDArray[np.float32]
    """The clip's [T, D], held before and after it."""
    pieces: NDArray[np.bool_]
    """Which `layout.PIECES` are kept [T, P]."""
    led: NDArray[np.bool_]
    """Frames [T] whose root is on a path."""
    places: Places
    """Known values of the root, one row, seen from the frame `places.anchor`."""


@dataclass(frozen=True)
class Written:
    """The clip as its file has it, at the layout's frame rate, in the clip's world."""

    joints: NDArray[np.float64]
    """[n, M, 3]."""
    base: float
    """Height of what a task calls 0."""
    drawn: bool
    """Whether the file holds a figure of ours."""


@dataclass(frozen=True)
class EditFrames:
    """A task in frames: T frames of a result, n of them the clip's.

    All its positions and headings are as the clip's first frame sees them, in metres of the clip: the root
    there above the origin and facing +Z, the floor at height 0. What lies in other coordinates is `known`
    (the model's figure), `world` and `written` (the clip's world).
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
    path: NDArray[np.complex128]
    """Where the root must be [T], z + i x; NaN elsewhere."""
    pins: dict[tuple[int, int], tuple[float, float, float]]
    """Where joints must be, by frame and joint."""
    anchor: RootPath
    """The root in the frame `known.places.anchor`."""
    known: KnownFrames
    world: World
    written: Written
    scale: float
    """Size of the model's figure in that of the clip's."""
    lift: float
    """By how much the model's figure, in the clip's size, stands too low for the clip's feet, in metres."""
    remarks: tuple[str, ...]

    @property
    def pieces(self) -> NDArray[np.bool_]:
        """Which `layout.PIECES` are kept [T, P]."""
        return self.known.pieces

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
        """Joints that stay where they are [T, N]."""
        kept: NDArray[np.bool_] = self.pieces[:, piece_joints(self.layout)] & self.rooted[:, None]
        return kept

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
    own_turns = clip.posed or clip.figure
    turned = None if own_turns is None else at_rate(own_turns, clip.fps, layout.fps)
    face = None if clip.face is None else resample(clip.face, clip.fps, layout.fps)
    hands = layout.num_joints > BODY_JOINTS
    if not hands:
        joints = joints[:, :BODY_JOINTS]
    elif not clip.has_hands:
        if turned is None:
            joints = with_resting_hands(joints)
        else:
            turned = with_hands(turned)
            joints = np.concatenate([joints, turned.joints[:, BODY_JOINTS:]], axis=1)
        remarks.append("hands are not recorded in the clip: they rest where it is kept")
    origin = complex(ground(joints[0, 0]))
    turn = float(facing(joints[:1])[0])
    floor = float(joints[..., 1].min())
    # The clip as its first frame sees it.
    if drawn is None:
        if turned is None or len(turned.skeleton) != layout.num_joints:
            figure = fit_rigid(canonicalize(joints), layout.skeleton)
        else:
            figure = moved(turned, -turn, -origin * np.exp(-1j * turn), -floor)
        world = World(origin, turn, 0.0)
    else:
        figure = moved(drawn, -turn, -origin * np.exp(-1j * turn), -floor)
        world = World(origin, turn, floor)
    written, base = _written(task, clip, layout.fps, joints, figure, world)
    own = figure.joints
    # The features must be of the figure that the model knows; `scale` and `lift` lead back to the clip's.
    retargeted = retarget(own, layout.skeleton)
    standing = canonicalize(retargeted)
    scale = float(retargeted[0, 0, 1] / own[0, 0, 1])
    lift = float(retargeted[0, 0, 1] - standing[0, 0, 1]) / scale
    features = encode(standing, layout, face if layout.has("face") else None)
    # Features of steps have one frame less than the joints.
    face = None if face is None else face[: len(features)]
    if layout.has("face") and face is None:
        remarks.append("the clip has no face, so the model makes it")
    lead = round(task.lead * layout.fps)
    clip_frames = len(features)
    total = lead + (clip_frames if task.seconds is None else max(2, round(task.seconds * layout.fps)))
    # A result that is shorter than the clip takes no notice of what the clip does later.
    features = features[: total - lead]
    rows = slice(len(features))
    figure = RigidMotion(figure.skeleton, figure.rotations[rows], figure.root[rows], own[rows], figure.error)
    heading, x, z = (one.numpy() for one in torch_way(torch.from_numpy(features).double(), layout))
    clip_root = RootPath(heading, (z + 1j * x) / scale)
    timed = TimedTask(task, layout, lead, total)
    pieces = timed.pieces(len(features)) & present(clip)
    path = timed.path(world)
    timed.require_free(path, pieces[:, LOWER], clip_root)
    pins = timed.pins(pieces, world)
    places, anchor = _known_places(timed, clip_root, pieces[:, LOWER], path, scale)
    return EditFrames(
        task=task,
        layout=layout,
        lead=lead,
        figure=figure,
        face=None if face is None else np.asarray(face[rows], np.float32),
        clip_root=clip_root,
        path=path,
        pins=pins,
        anchor=anchor,
        known=KnownFrames(_held(features, layout, lead, total), pieces, ~np.isnan(path), places),
        world=world,
        written=Written(written[rows], base, drawn is not None),
        scale=scale,
        lift=lift,
        remarks=tuple(remarks),
    )


def _written(
    task: EditTask,
    clip: RecordedClip,
    fps: float,
    joints: NDArray[np.float64],
    figure: RigidMotion,
    world: World,
) -> tuple[NDArray[np.float64], float]:
    """Joints [n, M, 3] at `fps` as the clip's file has them, of the `joints` that were read, and the height
    there of what a task calls 0.
    """
    if task.changes_clip:
        return moved(figure, world.turn, world.origin, 0.0).joints, 0.0
    if clip.bvh is not None:
        rows = clip.bvh.places()
        return resample(rows, clip.bvh.motion.fps, fps), float(rows[..., 1].min())
    if clip.figure is not None and clip.figure.joints.shape[1] == joints.shape[1]:
        return resample(clip.figure.joints, clip.fps, fps), 0.0
    return joints - np.array([0.0, joints[..., 1].min(), 0.0]), 0.0


def _known_places(
    timed: TimedTask, clip: RootPath, rooted: NDArray[np.bool_], path: NDArray[np.complex128], scale: float
) -> tuple[Places, RootPath]:
    """Known values of the root, on the model's figure and seen from an anchor; and the root in that frame, as
    the clip's first frame sees it.

    The anchor is the first frame whose root is kept. Without one it is where the path begins, and without a
    path the clip's first frame.
    """
    heading = np.zeros(len(rooted))
    place = np.zeros(len(rooted), dtype=np.complex128)
    lead = timed.lead
    fps = timed.layout.fps
    inside = slice(lead, lead + len(clip.heading))
    heading[inside] = clip.heading
    place[inside] = clip.place
    on_path = ~np.isnan(path)
    place[on_path] = path[on_path]
    heading_known = rooted.copy()
    place_known = rooted | on_path
    # Who walks a drawn path faces where it goes, but not at once where something is kept.
    at = np.flatnonzero(place_known)
    way = np.zeros_like(place)
    if len(at) > 1:
        way[at] = np.gradient(place[at], at) * fps
    walks = on_path & (np.abs(way) > WALKS)
    for frame in np.flatnonzero(rooted):
        walks[max(0, frame - round(_TURNS * fps)) : frame + round(_TURNS * fps) + 1] = False
    heading[walks] = np.angle(way[walks]) + np.pi * timed.task.backward
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
