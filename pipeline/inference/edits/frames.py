"""A task in frames: what is known of the result's frames, and what is asked of them.

All of it is seen from the clip's first frame: its root above the origin, facing +Z, the floor at height 0.
Clips of other proportions than the layout's figure are posed on that figure for the model, and what it makes
is put back on the clip's bones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.motion.body.resting_hands import with_resting_hands
from motionloom.datasets.motion.canonical import canonicalize, facing, ground, resample, retarget
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.features.torch_joints import torch_way
from motionloom.datasets.motion.figure_parts import (
    LOWER,
    PIECES,
    piece_columns,
    piece_joints,
    pieces_of,
    step_columns,
)
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.editing import FASTEST, EditTask, FramePin, KnownWay
from motionloom.pipeline.inference.edits.recorded import RecordedClip

SAME_BONES = 0.05
"""Mean difference of bone lengths up to which a clip's figure counts as the layout's."""

WORDS_EASE = 0.3
"""Seconds in which one stretch of words takes over from another."""


@dataclass(frozen=True)
class Way:
    """The root's way in every frame of the result, in metres and radians."""

    heading: NDArray[np.float64]
    place: NDArray[np.complex128]
    """z + i x."""


@dataclass(frozen=True)
class EditFrames:
    """T frames of a result, n of them the clip's."""

    task: EditTask
    layout: MotionLayout
    lead: int
    """Frames before the clip's first."""
    joints: NDArray[np.float64]
    """The clip's [n, N, 3] on its own bones."""
    face: NDArray[np.float32] | None
    """[n, 50]."""
    clip_way: Way
    """The clip's, n frames."""
    features: NDArray[np.float32]
    """[T, D]: the clip's on the model's figure, held before and after it."""
    pieces: NDArray[np.bool_]
    """What is kept [T, P]."""
    anchor: Way
    """Of one frame: the one that the model's way is seen from."""
    way: KnownWay
    """On the model's figure."""
    path: NDArray[np.complex128]
    """Where the root must be [T], z + i x; NaN elsewhere."""
    pins: dict[tuple[int, int], tuple[float, float, float]]
    scale: float
    """Size of the model's figure in that of the clip's."""
    lift: float
    """By how much the model's figure, in the clip's size, stands too low for the clip's feet, in metres."""
    origin: complex
    """Where the clip's first root stands in the clip's world, z + i x, and how it is turned there."""
    turn: float
    remarks: tuple[str, ...]

    @property
    def frames(self) -> int:
        return len(self.pieces)

    @property
    def inside(self) -> slice:
        """The clip's frames among those of the result."""
        return slice(self.lead, self.lead + len(self.joints))

    @property
    def rooted(self) -> NDArray[np.bool_]:
        """Frames whose root is kept [T]."""
        return self.pieces[:, LOWER]

    @property
    def kept_joints(self) -> NDArray[np.bool_]:
        """Joints that stay where they are in the world [T, N]."""
        kept: NDArray[np.bool_] = self.pieces[:, piece_joints(self.layout)] & self.rooted[:, None]
        return kept

    @property
    def whole(self) -> NDArray[np.bool_]:
        """Frames all of whose joints are kept [T]."""
        whole: NDArray[np.bool_] = np.all(self.kept_joints, axis=1)
        return whole

    def to_world(self, joints: NDArray[np.float64]) -> NDArray[np.float64]:
        """Joints [T, N, 3] in the clip's world, the floor at height 0."""
        plane = ground(joints) * np.exp(1j * self.turn) + self.origin
        return np.stack([plane.imag, joints[..., 1], plane.real], axis=-1)

    def require_work(self) -> None:
        """Refuse a task that leaves nothing to make, and one that takes nothing from the clip."""
        there = np.isin(np.arange(len(PIECES)), piece_columns(self.layout))
        if self.pieces[:, there].all():
            raise UserError(
                "everything of the clip is kept, so there is nothing to make: keep less of it, or give "
                "seconds or lead for more"
            )
        if not (self.pieces.any() or self.pins or np.isfinite(self.path).any() or self.task.likeness):
            raise UserError(
                "nothing of the clip is kept and nothing else is asked: say what to keep, draw a path, pin "
                "a joint, or set likeness"
            )

    @staticmethod
    def of(task: EditTask, clip: RecordedClip, layout: MotionLayout) -> EditFrames:
        """`UserError` for a task that cannot be done with the clip."""
        remarks = []
        if abs(clip.fps - layout.fps) > 1e-6:
            remarks.append(f"read at {clip.fps:g} frames/s, edited at the model's {layout.fps:g}")
        joints = resample(clip.joints, clip.fps, layout.fps)
        face = None if clip.face is None else resample(clip.face, clip.fps, layout.fps)
        hands = layout.num_joints > BODY_JOINTS
        if not hands:
            joints = joints[:, :BODY_JOINTS]
        elif not clip.has_hands:
            joints = with_resting_hands(joints)
            remarks.append("the clip has no hands, so the model makes them")
        origin, turned = complex(ground(joints[0, 0])), float(facing(joints[:1])[0])
        own = canonicalize(joints)
        off = _differs(own, layout.skeleton)
        work, scale, lift = own, 1.0, 0.0
        if off > SAME_BONES:
            posed = retarget(own, layout.skeleton)
            work = canonicalize(posed)
            scale = float(posed[0, 0, 1] / own[0, 0, 1])
            lift = float(posed[0, 0, 1] - work[0, 0, 1]) / scale
            remarks.append(
                f"its bones differ from the model's by {off:.0%}: the model moves its own figure, and what "
                f"it makes is put back on the clip's bones"
            )
        features = encode(work, layout, face if layout.has("face") else None)
        own = own[: len(features)]
        face = None if face is None else face[: len(features)]
        if layout.has("face") and face is None:
            remarks.append("the clip has no face, so the model makes it")
        has = np.array([True] * 4 + [clip.has_hands or not hands] * 2 + [face is not None])
        first, clip_end = round(task.lead * layout.fps), len(own)
        total = first + (clip_end if task.seconds is None else max(1, round(task.seconds * layout.fps)))
        own = own[: total - first]
        clip_way = _way_of(features[: len(own)], layout, scale)
        maker = _Frames(task, layout, first, total, clip.seconds)
        pieces = maker.pieces(len(own)) & has
        path = maker.path(origin, turned)
        maker.require_free(path, pieces[:, LOWER], clip_way)
        pins = maker.pins(pieces, origin, turned)
        way, anchor = _known_way(clip_way, first, pieces[:, LOWER], path, scale)
        return EditFrames(
            task, layout, first, own, face if face is None else np.asarray(face[: len(own)], np.float32),
            clip_way, _held(features[: len(own)], layout, first, total), pieces, anchor, way, path, pins,
            scale, lift, origin, turned, tuple(remarks),
        )  # fmt: skip

    def model_pins(self) -> list[FramePin]:
        """The pins on the model's figure, seen from the anchor."""
        out = []
        for (frame, joint), (x, y, z) in self.pins.items():
            away = (complex(z, x) - self.anchor.place[0]) * np.exp(-1j * self.anchor.heading[0]) * self.scale
            height = (y - self.lift) * self.scale
            out.append(FramePin(frame, joint, (float(away.imag), height, float(away.real))))
        return out

    def shares(self) -> list[tuple[str, NDArray[np.float64]]]:
        """Each stretch of words and its share of every frame [T]; the shares of a frame sum to 1."""
        fps, frames = self.layout.fps, np.arange(self.frames)
        ease = max(1.0, WORDS_EASE * fps)
        out = []
        for said in self.task.words:
            start, end = ((at * fps) + self.lead for at in (said.start, said.end))
            out.append((said.text, np.clip(np.minimum(frames - start, end - frames) / ease + 0.5, 0.0, 1.0)))
        rest = 1 - sum((share for _, share in out), np.zeros(self.frames))
        out.append((self.task.caption, np.clip(rest, 0.0, 1.0)))
        total = np.sum([share for _, share in out], axis=0)
        return [(text, share / total) for text, share in out if share.any()]


class _Frames:
    """The times of a task as frames of the result."""

    def __init__(
        self, task: EditTask, layout: MotionLayout, lead: int, frames: int, clip_seconds: float
    ) -> None:
        self.task, self.layout, self.lead, self.frames = task, layout, lead, frames
        self.clip_seconds = clip_seconds

    def at(self, what: str, seconds: float) -> int:
        """The frame at a time, which the result must have."""
        frame = round(seconds * self.layout.fps) + self.lead
        if not 0 <= frame < self.frames:
            start, end = -self.lead / self.layout.fps, (self.frames - 1 - self.lead) / self.layout.fps
            raise UserError(f"{what} at {seconds:g} s: the result goes from {start:g} s to {end:.2f} s")
        return frame

    def pieces(self, clip_frames: int) -> NDArray[np.bool_]:
        """What is kept [T, P]."""
        task, fps = self.task, self.layout.fps
        out = np.zeros((self.frames, len(PIECES)), dtype=np.bool_)
        clip_end = self.lead + clip_frames
        for number, kept in enumerate(task.keep):
            start = self.lead + round(kept.start * fps)
            if start >= clip_end:
                raise UserError(
                    f"keep.{number}: it starts at {kept.start:g} s and the clip lasts "
                    f"{clip_frames / fps:.2f} s"
                )
            end = clip_end if kept.end is None else min(clip_end, self.lead + round(kept.end * fps))
            out[start:end] |= pieces_of(kept.parts, kept.but)
        if not task.keep and (task.words or self.frames > clip_frames):
            out[self.lead : clip_end] = True
            for said in task.words:
                start, end = (max(0, round(time * fps) + self.lead) for time in (said.start, said.end))
                out[start:end] = False
        return out

    def path(self, origin: complex, turned: float) -> NDArray[np.complex128]:
        """Where the root must be [T]; NaN elsewhere."""
        from scipy.interpolate import PchipInterpolator

        out = np.full(self.frames, np.nan, dtype=np.complex128)
        if not self.task.path:
            return out
        frames = [self.at("path", point.at) for point in self.task.path]
        places = np.array([complex(point.z, point.x) for point in self.task.path])
        places = (places - origin) * np.exp(-1j * turned)
        if len(set(frames)) < len(frames):
            raise UserError(f"path: two of its points are in one frame of {1 / self.layout.fps:.3g} s")
        if len(frames) == 1:
            out[frames[0]] = places[0]
            return out
        inside = np.arange(frames[0], frames[-1] + 1)
        out[inside] = PchipInterpolator(frames, places.real)(inside)
        out[inside] += 1j * PchipInterpolator(frames, places.imag)(inside)
        return out

    def require_free(self, path: NDArray[np.complex128], rooted: NDArray[np.bool_], way: Way) -> None:
        """Refuse a path where the root is kept, or that nobody gets to from where it is kept."""
        asked = np.flatnonzero(~np.isnan(path))
        if not len(asked):
            return
        if rooted[asked].any():
            at = (int(asked[rooted[asked]][0]) - self.lead) / self.layout.fps
            raise UserError(f"path: at {at:g} s the legs are kept, and with them where they go")
        for frame in np.flatnonzero(rooted):
            near = asked[np.abs(asked - frame).argmin()]
            seconds = abs(int(near) - int(frame)) / self.layout.fps
            speed = abs(path[near] - way.place[frame - self.lead]) / seconds
            if speed > FASTEST:
                raise UserError(
                    f"path: {speed:.0f} m/s between where the root is kept and "
                    f"{(int(near) - self.lead) / self.layout.fps:g} s; nobody runs faster than "
                    f"{FASTEST:g} m/s"
                )

    def pins(
        self, pieces: NDArray[np.bool_], origin: complex, turned: float
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
            place = (complex(z, x) - origin) * np.exp(-1j * turned)
            out[frame, joint] = (float(place.imag), y, float(place.real))
        return out


def _differs(joints: NDArray[np.float64], skeleton: Skeleton) -> float:
    """Mean difference of the body's bone lengths from a skeleton's, as a share of these."""
    own = np.linalg.norm(skeleton.with_lengths_of(joints).offsets, axis=-1)[1:BODY_JOINTS]
    usual = np.linalg.norm(skeleton.offsets, axis=-1)[1:BODY_JOINTS]
    return float(np.abs(own - usual).sum() / usual.sum())


def _way_of(features: NDArray[np.float32], layout: MotionLayout, scale: float) -> Way:
    """The way that features [T, D] go, on the clip's own size."""
    heading, x, z = (one.numpy() for one in torch_way(torch.from_numpy(features).double(), layout))
    return Way(heading, (z + 1j * x) / scale)


def _known_way(
    clip: Way, lead: int, rooted: NDArray[np.bool_], path: NDArray[np.complex128], scale: float
) -> tuple[KnownWay, Way]:
    """What is known of the way, on the model's figure and seen from an anchor; and that anchor, on the
    clip's.

    The anchor is the first frame whose root is kept. Without one it is where the path begins, facing along
    it, and without a path the clip's first frame.
    """
    frames = len(rooted)
    heading, place = np.zeros(frames), np.zeros(frames, dtype=np.complex128)
    inside = slice(lead, lead + len(clip.heading))
    heading[inside], place[inside] = clip.heading, clip.place
    asked = ~np.isnan(path)
    place[asked] = path[asked]
    turned, stood = rooted.copy(), rooted | asked
    if rooted.any():
        first = int(np.flatnonzero(rooted)[0])
    elif asked.any():
        points = np.flatnonzero(asked)
        first = int(points[0])
        away = path[points] - path[first]
        far = np.flatnonzero(np.abs(away) > 0.5)
        heading[first] = np.angle(away[far[0] if len(far) else -1]) if np.abs(away[-1]) > 0 else 0.0
        turned[first] = True
    else:
        first = lead
        turned[first] = stood[first] = True
    anchor = Way(heading[first : first + 1], place[first : first + 1])
    seen = (place - anchor.place) * np.exp(-1j * anchor.heading) * scale
    known = KnownWay(
        first, heading - anchor.heading, np.stack([seen.real, seen.imag], axis=-1), turned, stood
    )
    return known, anchor


def _held(features: NDArray[np.float32], layout: MotionLayout, lead: int, frames: int) -> NDArray[np.float32]:
    """Features [n, D] from frame `lead` on, standing still before and after: [T, D]."""
    at = np.clip(np.arange(frames) - lead, 0, len(features) - 1)
    out = features[at].copy()
    outside = (np.arange(frames) < lead) | (np.arange(frames) >= lead + len(features))
    out[np.ix_(outside, step_columns(layout))] = 0.0
    return out
