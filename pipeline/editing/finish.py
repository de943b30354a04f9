"""Motions that a model made of a task: posed on the clip's figure, moved onto what is asked, and measured."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.chain_solver import solve_poses
from motionloom.datasets.motion.body.feet import foot_contacts, plant_feet
from motionloom.datasets.motion.body.rigid import RigidMotion, share_twist
from motionloom.datasets.motion.bvh.own_file import OwnBvh
from motionloom.datasets.motion.canonical import facing, ground, retarget
from motionloom.datasets.motion.easing import eased
from motionloom.datasets.motion.features.codec import encode, place
from motionloom.datasets.motion.features.torch_joints import torch_way
from motionloom.datasets.motion.kinematics import forward_kinematics, joints_to_rotations
from motionloom.datasets.motion.layout import PIECES, piece_joints
from motionloom.models.metrics.dance import ANKLES_TOES
from motionloom.pipeline.editing.frames import WALKS, EditFrames
from motionloom.pipeline.editing.landing import landed, reached
from motionloom.pipeline.editing.own_file import between_rows, own_rows, with_made
from motionloom.pipeline.editing.task import EditReport
from motionloom.pipeline.editing.timed import RootPath
from motionloom.pipeline.inference.clip_file import RecordedClip

_REACH_SECONDS = 0.5
"""In which a figure goes to a pin and comes back [ours]."""
_REACHED = 0.01
"""Metres from its pin at which a joint is there."""
_SEAM_FRAMES = 2
"""Frames on either side of a seam that belong to it."""
_TRUNK_AND_ARMS = (1, 2, 3)
"""Numbers of the `PIECES` that keep their direction where what carries them is made; fingers follow hands."""


def finish(
    frames: EditFrames, made: NDArray[np.float32]
) -> tuple[NDArray[np.float32], RigidMotion, NDArray[np.float64]]:
    """Pose the clip's figure by features of body and hands [T, D], as a model made them.

    Returns the features of what came, the figure in the clip's world, and its headings there [T].
    `UserError` for a pin that it does not reach.
    """
    layout = frames.layout.without_face()
    rooted = frames.rooted
    posed, heading = _posed(frames, made)
    hold = partial(_with_kept, frames, heading)
    figure = hold(posed)
    contacts = foot_contacts(figure.joints, figure.skeleton, layout.fps) & ~rooted[:, None]
    figure = hold(plant_feet(figure, posed.joints, contacts, layout.fps, rooted)[0])
    if frames.pins:
        blend = max(2, round(_REACH_SECONDS * layout.fps))
        figure = reached(figure, frames.pins, frames.kept_joints, blend, hold)
    joints = figure.joints
    missed = {}
    for (frame, joint), wanted in frames.pins.items():
        away = float(np.linalg.norm(joints[frame, joint] - np.asarray(wanted)))
        missed[f"{figure.skeleton.joints[joint]} at {(frame - frames.lead) / layout.fps:.2f} s"] = away
    far = max(missed, key=missed.__getitem__, default="")
    if far and missed[far] > _REACHED:
        raise UserError(
            f"pins: {far} is out of reach: the figure gets within {100 * missed[far]:.1f} cm of it; pin it "
            f"nearer, keep less around it, or draw a path that leads there"
        )
    if layout.family != "exact":
        # These are made of steps between joints, so there is one frame more of joints.
        joints = np.concatenate([joints, 2 * joints[-1:] - joints[-2:-1]])
    return encode(joints, layout), frames.world.figure(figure), heading + frames.world.turn


def own_bvh(bvh: OwnBvh, frames: EditFrames, figure: RigidMotion) -> OwnBvh:
    """The clip's own file with a figure in the clip's world. `UserError` where that is not possible."""
    if frames.task.changes_clip:
        raise UserError("the clip was mirrored, retimed or repeated")
    kept = frames.pieces[:, piece_joints(frames.layout)]
    return with_made(bvh, figure.joints, frames.layout.fps, frames.lead, kept, frames.task.seconds)


def own_figure(clip: RecordedClip, frames: EditFrames, made: RigidMotion) -> RigidMotion:
    """A figure in the clip's world at the frame rate of the clip's own, with its numbers where it is kept."""
    from scipy.spatial.transform import Slerp

    own = clip.figure
    fps = frames.layout.fps
    assert own is not None
    kept = frames.pieces[:, piece_joints(frames.layout)]
    source, at, kept = own_rows(len(own.root), clip.fps, fps, frames.lead, kept, frames.task.seconds)
    when = np.arange(len(made.root))
    turned = [Slerp(when, Rotation.from_matrix(one))(at).as_matrix() for one in made.rotations.swapaxes(0, 1)]
    rotations = np.stack(turned, axis=1)
    root = np.stack([np.interp(at, when, axis) for axis in made.root.T], axis=-1)
    # Rotations of kept joints count where what carries them is kept too.
    held = kept & kept[:, np.maximum(own.skeleton.parents, 0)]
    rotations[held] = own.rotations[source][held]
    root[kept[:, 0]] = own.root[source][kept[:, 0]]
    out = RigidMotion.posed(own.skeleton, rotations, root, between_rows(made.joints, at))
    whole = kept.all(axis=1)
    out.joints[whole] = own.joints[source][whole]
    return out


def _posed(frames: EditFrames, made: NDArray[np.float32]) -> tuple[RigidMotion, NDArray[np.float64]]:
    """The clip's figure in the poses that a model made, its root led to where it is kept or asked for; and
    its headings [T].
    """
    layout = frames.layout.without_face()
    own = frames.figure.skeleton
    root = _made_root(frames, made)
    rooted = frames.rooted
    inside = frames.inside
    joints = place(made, layout, np.exp(1j * root.heading), root.place)
    # Between where it is kept or asked for the root is eased, so that nothing jumps.
    target = root.place.copy()
    heading = root.heading.copy()
    target[inside] = np.where(rooted[inside], frames.clip_root.place, target[inside])
    heading[inside] = np.where(rooted[inside], frames.clip_root.heading, heading[inside])
    on_path = frames.known.led
    target[on_path] = frames.path[on_path]
    # Whole turns of a path count for nothing; every half second is enough, so that hips may sway.
    places = frames.known.places
    known = places.heading_known[0].numpy()
    asked = known & ~rooted
    heading[asked] = (places.heading[0].numpy() + frames.anchor.heading)[asked]
    known &= rooted | (np.arange(len(known)) % max(1, round(layout.fps / 2)) == 0)
    wrapped = np.angle(np.exp(1j * (heading - root.heading)))
    shift = eased(target - root.place, rooted | on_path)
    turn = eased(wrapped, known)
    # The bones' directions are the model's, their lengths the clip's.
    targets = retarget(joints, layout.skeleton, own.offsets)
    targets[..., 1] += (joints[:, 0, 1] / frames.scale + frames.lift - targets[:, 0, 1])[:, None]
    shift += root.place - ground(targets[:, 0])
    targets, heading = landed(targets, root.heading, shift, turn)
    start = joints_to_rotations(targets, own)
    turned, there = solve_poses(targets, own.offsets, own.parents, start, targets[:, 0])
    return RigidMotion.posed(own, share_twist(turned, own), there, targets), heading


def _with_kept(frames: EditFrames, heading: NDArray[np.float64], figure: RigidMotion) -> RigidMotion:
    """The figure with the clip's own poses where they are kept, and its root on its path."""
    clip = frames.figure
    inside = frames.inside
    pieces = piece_joints(frames.layout)
    rotations = figure.rotations.copy()
    root = figure.root.copy()
    rooted = frames.rooted[inside]
    kept = frames.pieces[inside][:, pieces]
    own = rotations[inside]
    own[kept] = clip.rotations[kept]
    root[inside][rooted] = clip.root[rooted]
    on_path = frames.known.led
    root[on_path, 2] = frames.path[on_path].real
    root[on_path, 0] = frames.path[on_path].imag
    turn = Rotation.from_euler("y", (heading[inside] - frames.clip_root.heading)[:, None]).as_matrix()
    posing = (clip.skeleton.offsets, clip.skeleton.parents)
    _, was = forward_kinematics(clip.rotations, clip.root, *posing)
    for joint, parent in enumerate(clip.skeleton.parents):
        loose = kept[:, joint] & ~kept[:, parent]
        wanted = turn @ was[:, joint]
        if pieces[joint] in _TRUNK_AND_ARMS and loose.any():
            _, now = forward_kinematics(own, clip.root, *posing)
            own[loose, joint] = (now[:, parent].swapaxes(-1, -2) @ wanted)[loose]
    return RigidMotion.posed(clip.skeleton, rotations, root, figure.joints)


def _made_root(frames: EditFrames, made: NDArray[np.float32]) -> RootPath:
    """The root's path in what a model made, in the clip's size, seen from the clip's first frame."""
    heading, x, z = (one.numpy() for one in torch_way(torch.from_numpy(made).double(), frames.layout))
    first = int(frames.known.places.anchor[0])
    anchor = frames.anchor
    place = (z + 1j * x) * np.exp(-1j * heading[first])
    away = (place - place[first]) * np.exp(1j * anchor.heading[0]) / frames.scale
    return RootPath(heading - heading[first] + anchor.heading[0], anchor.place[0] + away)


def report_of(
    frames: EditFrames, joints: NDArray[np.float64], heading: NDArray[np.float64], rate: float
) -> EditReport:
    """How near a result is to its task, by the joints [T, M, 3] of its file of some `rate`, and headings [T],
    in the clip's world.
    """
    fps = frames.layout.fps
    inside = frames.inside
    count = min(joints.shape[1], frames.written.joints.shape[1])
    joints = joints[:, :count]
    clip = frames.written.joints[:, :count]
    rooted = frames.rooted[inside][:, None]
    pieces = piece_joints(frames.layout)[:count]
    names = frames.layout.skeleton.joints
    parents = np.maximum(frames.layout.skeleton.parents[:count], 0)
    # Without the legs the figure goes elsewhere, so what is kept of it is compared bone by bone, as the
    # figure sees it; fingers are kept within a hand, which goes with its arm.
    kept = frames.pieces[inside].copy()
    kept[:, 4:6] &= kept[:, 2:4]
    kept = kept[:, pieces] & (rooted | kept[:, pieces][:, parents])
    # A frame that lies between two rows of the file is the clip's where the one before it is kept, too.
    kept[1:] &= kept[:-1] | (frames.rows(rate)[inside] % 1 == 0)[1:, None]
    back = frames.clip_root.heading + frames.world.turn - heading[inside]
    back = Rotation.from_euler("y", back[:, None]).as_matrix()
    bones = np.einsum("tij,tnj->tni", back, joints[inside] - joints[inside][:, parents])
    away = np.where(rooted[..., None], joints[inside] - clip, bones - (clip - clip[:, parents]))
    # The way is looked at where the root walks; a figure that stands may face anywhere.
    on_path = frames.known.led
    root = ground(joints[:, 0])
    path = frames.world.places(frames.path)
    pins = {}
    for (frame, joint), pin in zip(frames.pins, frames.task.pins, strict=True):
        if joint < count:  # not fingers of a file that has none
            miss = np.linalg.norm(joints[frame, joint] - pin.position - np.array([0, frames.written.base, 0]))
            pins[f"{names[joint]} at {(frame - frames.lead) / fps:.2f} s"] = 100 * miss.item()
    way = np.gradient(root) * fps
    walks = on_path & (np.abs(way) > WALKS)
    aside = np.abs(np.angle(way * np.exp(-1j * facing(joints))))[walks]
    body = frames.pieces[:, np.isin(np.arange(len(PIECES)), pieces)]
    # Frames after which it changes what is kept, and the inner frames around them.
    seams = np.flatnonzero((body[1:] != body[:-1]).any(axis=1))
    near = (np.abs(np.arange(1, len(joints) - 1)[:, None] - seams - 0.5) < _SEAM_FRAMES).any(axis=1)
    free = ~frames.rooted
    return EditReport(
        kept_cm=_largest(100 * np.linalg.norm(away, axis=-1)[kept]),
        path_cm=_largest(100 * np.abs(root - path)[on_path]),
        pins_cm=pins,
        aside_degrees=float(np.degrees(aside.mean())) if walks.any() else float("nan"),
        seams=_largest(accelerations(joints, fps)[near]),
        inside=_largest(accelerations(clip, fps)),
        sliding=sliding(joints, fps, free[1:] | free[:-1]),
        clip_sliding=sliding(clip, fps, np.ones(len(clip) - 1, dtype=np.bool_)),
    )


def _largest(values: NDArray[np.float64]) -> float:
    """The largest value; NaN where there are none."""
    return float(values.max(initial=-np.inf)) if values.size else float("nan")


def sliding(joints: NDArray[np.float64], fps: float, steps: NDArray[np.bool_]) -> float:
    """Speed along the floor of the slowest of ankles and balls, cm/s, on average over some of the steps."""
    feet = ground(joints[:, [joint for foot in ANKLES_TOES for joint in foot]])
    slowest = 100 * fps * np.abs(np.diff(feet, axis=0)).min(axis=1)
    return float(slowest[steps].mean()) if steps.any() else float("nan")


def accelerations(joints: NDArray[np.floating], fps: float) -> NDArray[np.float64]:
    """Mean size of the joints' accelerations in every inner frame [T - 2], m/s², of joints [T, N, 3]."""
    second = np.diff(np.asarray(joints, dtype=np.float64), n=2, axis=0) * fps**2
    return np.asarray(np.linalg.norm(second, axis=-1).mean(axis=-1))
