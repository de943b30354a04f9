"""A user's BVH file of which a part is written anew, on its own skeleton and at its own rate [ours].

Rows of kept frames stay the file's text. In the others each rotation is eased between the kept frames at both
ends, which gives twists and joints that no map names; from there `chain_solver` poses the mapped joints.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.chain_solver import solve_poses
from motionloom.datasets.motion.bvh.motion import BvhMotion, channel_columns, read_bvh
from motionloom.datasets.motion.bvh.own_file import OwnBvh
from motionloom.datasets.motion.bvh.text import Floats, find_motion
from motionloom.datasets.motion.easing import between_known, smooth
from motionloom.datasets.motion.kinematics import forward_kinematics, nearest_rotations

_FADE = 0.25
"""Seconds in which made joints leave the file's, from which the model's figure is millimetres away; more
between frames, where kept rows go on for part of one."""
_HELD, _LOOSE, _PRIOR = 1e3, 1e-4, 1e-6
"""Weights of joints that stay, of those that the map does not name, and of no turn against the bones."""
_FRAMES = re.compile(rb"(Frames[ \t]*:[ \t]*)\S+", re.IGNORECASE)

Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]


def with_made(
    bvh: OwnBvh, joints: Floats, fps: float, lead: int, kept: Mask, seconds: float | None
) -> OwnBvh:
    """The file with made joints [T, N, 3], in metres and Y up, where not all is kept [T, N].

    `lead` frames come before the file's first; `seconds` are the result's from there on, or None: the
    file's. `UserError` where its skeleton cannot be posed so, or no frame is kept where it was.
    """
    motion = bvh.motion.with_ends(bvh.joint_map.ends)
    parents = motion.parents
    (positions, turns) = channel_columns(motion.channels)
    sources = enumerate(bvh.joint_map.sources[: joints.shape[1]])
    target = {motion.joints.index(names[0]): joint for joint, names in sources if len(names) == 1}
    moving = _moving(motion, target)
    source, at, kept = own_rows(motion.frames - bvh.added, motion.fps, fps, lead, kept, seconds)
    source += bvh.added
    # A joint without a row in the map goes with its parent. A joint's numbers are the file's where it is
    # kept with all that carries it.
    carrier = [0] * len(parents)
    own, held = np.ones((2, len(source), len(parents)), dtype=np.bool_)
    for joint, parent in enumerate(parents):
        carrier[joint] = target.get(joint, carrier[max(parent, 0)])
        own[:, joint] = kept[:, carrier[joint]]
        held[:, joint] = own[:, joint] & held[:, max(parent, 0)]
    if not held[:, list(target)].any():
        raise UserError("no frame is kept where it was")
    posed = replace(motion, values=motion.values[source])
    made = np.flatnonzero(~held.all(axis=1))
    values = posed.values.copy()
    if not len(made):
        return _with_rows(bvh, values, source, held, made)
    first, last, share = between_known(own | ~own.any(axis=0), made)
    local = _eased(np.moveaxis(posed.local_rotations(range(len(parents))), 0, 1), first, last, share)
    for joint, _, column in positions:
        start, end = (posed.values[side[:, joint], column] for side in (first, last))
        values[made, column] = start + (end - start) * share[:, joint]
    wanted = _wanted(bvh, joints, at, target, posed, held)[made]
    offsets = np.median(posed.local_offsets(), axis=0) * bvh.unit
    root = replace(motion, values=values[made]).local_offsets()[:, 0] * bvh.unit
    local, place = _posed(motion, moving, list(target), local, root, offsets, wanted, held[made])
    for joint, axis, column in positions:
        if joint == moving:
            values[made, column] = np.where(
                held[made, joint], values[made, column], place[:, axis] / bvh.unit
            )
    _write_angles(values, made, local, turns, held)
    return _with_rows(bvh, values, source, held, made)


def _wanted(
    bvh: OwnBvh, joints: Floats, at: Floats, target: dict[int, int], posed: BvhMotion, held: Mask
) -> Floats:
    """Where mapped joints should be, the others as they are, [R, J, 3] in metres and the file's axes."""
    from scipy.interpolate import CubicSpline

    wanted = posed.positions() * bvh.unit
    mapped = list(target)
    made = CubicSpline(np.arange(len(joints)), joints)(at)[:, list(target.values())]
    if bvh.up == "z":
        made = np.stack([made[..., 0], -made[..., 2], made[..., 1]], axis=-1)
    # The made figure stands on a floor at height 0; what the last kept row is away from it goes slowly.
    named = held[:, mapped]
    rows = np.arange(len(at))
    away = wanted[:, mapped] - made
    shift = np.median(away[named], axis=0)
    away = (away - shift) * named[..., None]
    first, last, _ = between_known(named | ~named.any(axis=0), rows)
    fade: Floats = np.where(first == last, np.inf, last - first).clip(max=_FADE * posed.fps)
    for end, counts in ((first, True), (last, first != last)):
        near = (1 - smooth(np.abs(rows[:, None] - end) / fade)) * counts
        made += near[..., None] * np.take_along_axis(away, end[..., None], axis=0)
    wanted[:, mapped] = made + shift
    return wanted


def _with_rows(bvh: OwnBvh, values: Floats, source: Rows, held: Mask, made: Rows) -> OwnBvh:
    """The file with these rows after the added ones; kept numbers stay as they are written."""
    section = find_motion(bvh.data, bvh.motion.name)
    lines = [line for line in bvh.data[section.body :].split(b"\n") if line.strip()]
    rows = [lines[number] for number in source]
    joint_of = np.repeat(np.arange(len(bvh.motion.joints)), [len(c) for c in bvh.motion.channels])
    for number in made:
        words = rows[number].split()
        for column in np.flatnonzero(~held[number, joint_of]):
            words[column] = b"%.6f" % values[number, column]
        rows[number] = b" ".join(words)
    rows = lines[: bvh.added] + rows
    header = _FRAMES.sub(rb"\g<1>%d" % len(rows), bvh.data[section.start : section.body], count=1)
    data = b"".join([bvh.data[: section.start], header, b"\n".join(rows), b"\n"])
    return replace(bvh, data=data, motion=read_bvh(data, name=bvh.motion.name))


def own_rows(
    clip_rows: int, rate: float, fps: float, lead: int, kept: Mask, seconds: float | None
) -> tuple[Rows, Floats, Mask]:
    """Return, for each row of a result at a file's rate, the file's row that it comes from, its place among
    the frames of the result, and which joints are kept in it [R, N].

    Args:
        kept: Joints that are kept in each frame [T, N], at `fps`.
    """
    count = clip_rows if seconds is None else max(1, round(seconds * rate))
    row = np.arange(-round(lead / fps * rate), count)
    at = np.clip((row / rate * fps + lead).round(6), 0, len(kept) - 1)
    kept = kept[np.floor(at).astype(int)]  # a frame stands for the time until the next one
    return np.clip(row, 0, clip_rows - 1), at, kept & ((row >= 0) & (row < clip_rows))[:, None]


def between_rows(joints: NDArray[np.floating], at: Floats) -> Floats:
    """Joints [T, N, 3] on straight lines at places [R] among their frames."""
    left = np.floor(at).astype(int)
    share = (at - left)[:, None, None]
    right = np.minimum(left + 1, len(joints) - 1)
    return np.asarray(joints[left] * (1 - share) + joints[right] * share, dtype=np.float64)


def _moving(motion: BvhMotion, target: dict[int, int]) -> int:
    """The joint that takes the figure from place to place: the lowest with positions that carries it all."""
    moves = np.abs(motion.local_offsets() - motion.offsets).max(axis=(0, 2)) > 0
    chains = [{joint, *_above(motion, joint)} for joint in target]
    moving = max((joint for joint in set.intersection(*chains) if moves[joint]), default=0)
    if sum(name.endswith("position") for name in motion.channels[moving]) != 3:
        raise UserError(f"{motion.joints[moving]} has no three positions")
    for joint in {one for end in target for one in _above(motion, end)}:
        if joint >= moving and len(channel_columns(motion.channels)[1][joint][0]) != 3:
            raise UserError(f"{motion.joints[joint]} has no three rotations")
    return moving


def _above(motion: BvhMotion, joint: int) -> list[int]:
    """The joints that carry another."""
    parent = motion.parents[joint]
    return [] if parent < 0 else [parent, *_above(motion, parent)]


def _eased(local: Floats, first: Rows, last: Rows, share: Floats) -> Floats:
    """Rotations [R, J, 3, 3] on the shorter arc between those of two rows [R, J]."""
    from scipy.spatial.transform import Rotation

    number = np.arange(local.shape[1])
    start, end = (Rotation.from_matrix(local[row, number].reshape(-1, 3, 3)) for row in (first, last))
    way = (start.inv() * end).as_rotvec() * share.reshape(-1, 1)
    return np.asarray((start * Rotation.from_rotvec(way)).as_matrix().reshape(*first.shape, 3, 3))


def _posed(
    motion: BvhMotion, moving: int, mapped: list[int], local: Floats, root: Floats, offsets: Floats,
    wanted: Floats, held: Mask,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Local rotations [R, J, 3, 3] that take mapped joints to where they are wanted [R, J, 3], from eased
    ones; and where its parent sees the moving joint. What is `held` stays.
    """
    base, world = forward_kinematics(local, root, offsets, motion.parents)
    below: list[list[int]] = [[] for _ in offsets]
    for joint in range(len(offsets) - 1, 0, -1):
        below[motion.parents[joint]] += [joint] if joint in mapped else below[joint]
    inside = [joint for joint in range(len(offsets)) if moving in (joint, *_above(motion, joint))]
    # From the top down each joint comes with its parent and turns, by as little as it can, so that the mapped
    # joints below it are seen where they are wanted: the search begins with the twists of the eased pose.
    aims = base.copy()
    turns = np.broadcast_to(np.eye(3), local.shape).copy()
    for joint in inside:
        parent = motion.parents[joint]
        ends = below[joint]
        if joint == moving:
            points = [joint] * (joint in mapped) + ends
            middle, there = (one[:, points].mean(axis=1) for one in (base, wanted))
            turn = _fit(base[:, points] - middle[:, None], wanted[:, points] - there[:, None])
            turns[:, joint], aims[:, joint] = turn, there + _apply(turn, base[:, joint] - middle)
        else:
            turns[:, joint] = turn = turns[:, parent]
            aims[:, joint] = aims[:, parent] + _apply(turn, base[:, joint] - base[:, parent])
            seen = np.einsum("tij,tcj->tci", turn, base[:, ends] - base[:, joint, None])
            turns[:, joint] = _fit(seen, wanted[:, ends] - aims[:, joint, None]) @ turn
        turns[held[:, joint], joint], aims[held[:, joint], joint] = np.eye(3), base[held[:, joint], joint]
    weights = np.full(held.shape, _LOOSE)
    weights[:, mapped], aims[:, mapped] = 1.0, wanted[:, mapped]
    weights[held], aims[held] = _HELD, base[held]
    carriers = [-1, *(inside.index(motion.parents[joint]) for joint in inside[1:])]
    turned = turns @ world
    start = turned[:, inside]
    start[:, 1:] = start[:, carriers[1:]].swapaxes(-1, -2) @ start[:, 1:]
    posed, place = solve_poses(
        aims[:, inside], offsets[inside], carriers, start, aims[:, moving], weights[:, inside]
    )
    out = local.copy()
    parent = motion.parents[moving]
    out[:, inside] = posed
    if parent >= 0:
        back = world[:, parent].swapaxes(-1, -2)
        out[:, moving] = back @ out[:, moving]
        place = _apply(back, place - base[:, parent])
    return out, place


def _apply(turns: Floats, vectors: Floats) -> Floats:
    return np.asarray((turns @ vectors[..., None])[..., 0])


def _fit(bones: Floats, aims: Floats) -> Floats:
    """The rotations [R, 3, 3], as small as can be, that take bones [R, C, 3] nearest to where they aim."""
    moment = np.einsum("tci,tcj->tij", aims, bones)
    moment += (_PRIOR * np.square(bones).sum(axis=(1, 2)) + 1e-12)[:, None, None] * np.eye(3)
    return nearest_rotations(moment)


def _write_angles(
    values: Floats, made: Rows, local: Floats, turns: list[tuple[str, list[int]]], held: Mask
) -> None:
    """Put the angles of made rows [R, J, 3, 3] into the values, each triple the nearest to the row before: no
    angle steps by more than half a turn. Where they arrive a whole turn away from the kept row after them,
    the step is there.
    """
    from scipy.spatial.transform import Rotation

    joints = [joint for joint, (order, _) in enumerate(turns) if len(order) == 3]
    columns = np.array([turns[joint][1] for joint in joints])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # in gimbal lock one of the angles is chosen to be 0
        angles = [Rotation.from_matrix(local[:, one]).as_euler(turns[one][0], degrees=True) for one in joints]
    # The same rotation is also turned half round by the outer axes and past the inner one.
    both = np.stack(angles, axis=1) * np.array([[[[1, 1, 1]]], [[[1, -1, 1]]]])
    both[1] += 180.0
    for number, row in enumerate(made):
        before = values[max(row - 1, 0), columns]
        near = both[:, number] - 360 * np.round((both[:, number] - before) / 360)
        best = np.abs(near - before).sum(axis=-1).argmin(axis=0)
        free = np.flatnonzero(~held[row, joints])
        values[row, columns[free]] = near[best[free], free]
