"""BVH files: a fast reader for any skeleton and a writer whose rest pose other tools accept.

Reader: the hierarchy is parsed line by line, the motion block as one array. A joint may list any of the
six channels in any order; its position channels replace the matching components of its OFFSET; its rotation
channels compose in the order listed (`Zrotation Xrotation Yrotation` = Rz Rx Ry on column vectors, degrees).
Lengths stay in the file's unit.

Writer: metres in, centimetres out; the rest pose is the skeleton's T-pose with an End Site on every leaf,
because importers of Blender, Houdini and FBX tools take bone directions and lengths from it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_text
from motionloom.datasets.motion.bvh.text import Floats, find_motion, load_text, parse_hierarchy, read_values
from motionloom.datasets.motion.skeleton import Skeleton

WRITTEN_ORDER = "ZXY"
"""Rotation channels of written files: the usual order of motion-capture tools."""

CENTIMETRES = 100.0

END = "End Site of {}"
"""Name of a joint's End Site where that counts as a joint."""


@dataclass(frozen=True)
class BvhMotion:
    """One BVH clip of N joints and T frames, lengths in the file's unit."""

    name: str
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    """Parent index of every joint, -1 for the root; parents come before children."""
    offsets: Floats
    """OFFSET of every joint [N, 3]."""
    channels: tuple[tuple[str, ...], ...]
    """Channel names of every joint, in file order."""
    values: Floats
    """The motion block [T, total channels]: lengths and degrees."""
    fps: float
    """1 / frame time, snapped to a whole number where the printed digits allow one (0.0333333 is 30)."""
    ends: Mapping[int, Sequence[float]] = field(default_factory=dict)
    """OFFSET [3] of the End Site of the joints that have one."""

    @property
    def frames(self) -> int:
        return len(self.values)

    def with_ends(self, stated: Mapping[str, Sequence[float]] | None = None) -> BvhMotion:
        """The figure with End Sites as joints without channels behind the others, named as `END` says.

        `stated` are other End Sites of joints, in multiples of the distance from their parents.
        """
        bones = np.linalg.norm(self.local_offsets()[0], axis=-1)
        ends = dict(self.ends)
        for name, offset in (stated or {}).items():
            if name in self.joints:
                joint = self.joints.index(name)
                ends[joint] = (np.asarray(offset) * bones[joint]).tolist()
        if not ends:
            return self
        return replace(
            self,
            joints=(*self.joints, *(END.format(self.joints[joint]) for joint in ends)),
            parents=(*self.parents, *ends),
            offsets=np.concatenate([self.offsets, np.array(list(ends.values()), dtype=np.float64)]),
            channels=(*self.channels, *[()] * len(ends)),
            ends={},
        )

    def local_offsets(self) -> Floats:
        """Translation of every joint against its parent [T, N, 3]: OFFSET, replaced by position channels.

        Those of a joint below the root that are zero in every frame replace nothing: some writers list six
        channels on every joint and fill three, or fill all six of a few joints.
        """
        out = np.repeat(self.offsets[None], self.frames, axis=0)
        joints, axes, columns = np.array(channel_columns(self.channels)[0], dtype=int).reshape(-1, 3).T
        filled = np.array(self.parents) < 0
        np.logical_or.at(filled, joints, self.values[:, columns].any(axis=0))
        joints, axes, columns = joints[filled[joints]], axes[filled[joints]], columns[filled[joints]]
        out[:, joints, axes] = self.values[:, columns]
        return out

    def local_rotations(self, wanted: Sequence[int]) -> Floats:
        """Local rotations of joints, joint first [M, T, 3, 3]; identity without rotation channels."""
        from scipy.spatial.transform import Rotation  # half a second, which reading a header need not take

        out = np.broadcast_to(np.eye(3), (len(wanted), self.frames, 3, 3)).copy()
        turns = channel_columns(self.channels)[1]
        groups: dict[str, list[int]] = {}
        for row, joint in enumerate(wanted):
            if turns[joint][0]:
                groups.setdefault(turns[joint][0], []).append(row)
        for order, rows in groups.items():
            columns = [column for row in rows for column in turns[wanted[row]][1]]
            angles = self.values[:, columns].reshape(self.frames, len(rows), len(order))
            joint_first = np.moveaxis(angles, 0, 1).reshape(-1, len(order))
            turned = Rotation.from_euler(order, joint_first, degrees=True)
            out[rows] = turned.as_matrix().reshape(len(rows), self.frames, 3, 3)
        return out

    def turns(self) -> Floats:
        """World rotations of all joints [T, N, 3, 3], in the file's axes."""
        out = np.moveaxis(self.local_rotations(range(len(self.joints))), 0, 1).copy()
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                out[:, joint] = out[:, parent] @ out[:, joint]
        return out

    def at_rest(self) -> BvhMotion:
        """One frame of the figure in which nothing is turned."""
        still = np.array([name.endswith("position") for names in self.channels for name in names])
        return replace(self, values=np.where(still, self.values[:1], 0.0))

    def positions(self) -> Floats:
        # Offsets may move per frame, so `kinematics.forward_kinematics` does not fit. Time is the last axis,
        # in one piece: products of whole clips are then three times faster than batches of small matrices.
        # Rotations of joints without children move nothing.
        inner = sorted({parent for parent in self.parents if parent >= 0})
        local = np.ascontiguousarray(np.moveaxis(self.local_rotations(inner), 1, -1))
        rotation = dict(zip(inner, local, strict=True))
        world = np.ascontiguousarray(np.moveaxis(self.local_offsets(), 0, -1))
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                world[joint] = world[parent] + np.einsum("ijt,jt->it", rotation[parent], world[joint])
                if joint in rotation:
                    rotation[joint] = np.einsum("ijt,jkt->ikt", rotation[parent], rotation[joint])
        return np.ascontiguousarray(np.moveaxis(world, -1, 0))


@lru_cache(maxsize=8)
def channel_columns(
    channels: tuple[tuple[str, ...], ...],
) -> tuple[list[tuple[int, int, int]], list[tuple[str, list[int]]]]:
    """Return joint, axis and column of each position channel, and for each joint the order of its rotations
    (`ZXY`) and their columns. Kept, because the files of a collection mostly share their channels.
    """
    positions: list[tuple[int, int, int]] = []
    rotations: list[tuple[str, list[int]]] = []
    column = 0
    for joint, names in enumerate(channels):
        order = ""
        columns = []
        for name in names:
            if name.endswith("position"):
                positions.append((joint, "XYZ".index(name[0]), column))
            else:
                order += name[0]
                columns.append(column)
            column += 1
        rotations.append((order, columns))
    return positions, rotations


def read_bvh(source: Path | str | bytes, *, name: str | None = None) -> BvhMotion:
    """Read one clip from a path, or from the text or bytes of a file.

    A `str` that holds a line break is taken as text, any other as a path. `name` is what errors call the clip
    (default: the path). Raises `UserError` naming file, line and reason for anything malformed.
    """
    data, where = load_text(source, name)
    section = find_motion(data, where)
    joints = parse_hierarchy(data[: section.start], where)
    width = sum(len(c) for c in joints.channels)
    if width == 0:
        raise UserError(f"{where}: no joint has a channel, so there is no motion")
    return BvhMotion(
        name=where,
        joints=tuple(joints.names),
        parents=tuple(joints.parents),
        offsets=np.array(joints.offsets, dtype=np.float64),
        channels=tuple(joints.channels),
        values=read_values(data, section.body, section.frames, width, where),
        fps=section.fps,
        ends=joints.ends,
    )


def write_bvh(path: Path, skeleton: Skeleton, rotations: NDArray, root: NDArray, fps: float) -> None:
    """Write a clip as BVH: centimetres, T-pose rest, End Sites; six channels on the root, three elsewhere.

    `rotations` are local rotation matrices [T, N, 3, 3] against the skeleton's rest pose, `root` the position
    of joint 0 [T, 3] in metres. The file appears whole or not at all (temporary file, flush to disk, rename).
    """
    rotations = np.asarray(rotations, dtype=np.float64)
    root = np.asarray(root, dtype=np.float64)
    frames = len(root)
    if rotations.shape != (frames, len(skeleton), 3, 3) or root.shape != (frames, 3) or frames == 0:
        raise UserError(
            f"{path}: BVH of skeleton {skeleton.name} needs rotations [T, {len(skeleton)}, 3, 3] and root "
            f"[T, 3] with T > 0, got {list(rotations.shape)} and {list(root.shape)}"
        )
    if not (np.isfinite(rotations).all() and np.isfinite(root).all()):
        raise UserError(f"{path}: the motion holds NaN or infinite values; a BVH file cannot")
    if not fps > 0:
        raise UserError(f"{path}: fps = {fps} must be above 0")
    # A row lists the channels in the order of the hierarchy, which is not that of the skeleton's joints.
    order = _depth_first(skeleton)
    values = np.concatenate(
        [root * CENTIMETRES, _euler_degrees(rotations[:, order]).reshape(frames, -1)], axis=1
    )
    # Nine decimals: frame times of 1/30 and 1/29.97 s must come back as the rates that they were.
    lines = [
        "HIERARCHY",
        *_hierarchy_lines(skeleton, 0, 0),
        "MOTION",
        f"Frames: {frames}",
        f"Frame Time: {1 / fps:.9f}",
    ]
    row = " ".join(["%.6f"] * values.shape[1])
    lines += [row % tuple(frame) for frame in values.tolist()]
    write_text(path, "\n".join(lines) + "\n")


def _children(skeleton: Skeleton, joint: int) -> list[int]:
    return [child for child, parent in enumerate(skeleton.parents) if parent == joint]


def _depth_first(skeleton: Skeleton, joint: int = 0) -> list[int]:
    """Joint indices in the order a BVH hierarchy lists them."""
    return [joint, *(j for child in _children(skeleton, joint) for j in _depth_first(skeleton, child))]


def _hierarchy_lines(skeleton: Skeleton, joint: int, depth: int) -> list[str]:
    def offset(metres: NDArray) -> str:
        return "OFFSET " + " ".join(f"{value * CENTIMETRES:.6f}" for value in metres)

    rotation = " ".join(f"{axis}rotation" for axis in WRITTEN_ORDER)
    channels = f"3 {rotation}" if depth else f"6 Xposition Yposition Zposition {rotation}"
    children = _children(skeleton, joint)
    body = [offset(skeleton.offsets[joint]), f"CHANNELS {channels}"]
    if children:
        body += [line for child in children for line in _hierarchy_lines(skeleton, child, depth + 1)]
    else:  # half the parent bone goes on: a leaf of no length has no direction in other tools
        body += ["End Site", "{", "\t" + offset(skeleton.offsets[joint] / 2), "}"]
    kind = "JOINT" if depth else "ROOT"
    return [f"{kind} {skeleton.joints[joint]}", "{", *("\t" + line for line in body), "}"]


def _euler_degrees(rotations: Floats) -> Floats:
    """Euler angles [T, N, 3] in degrees, in `WRITTEN_ORDER`, without jumps of whole turns between frames.

    R = Rz(a) Rx(b) Ry(c), entry by entry: the libraries that know all orders take a second to import.
    """
    level = np.hypot(rotations[..., 0, 1], rotations[..., 1, 1])  # |cos b|
    first = np.arctan2(-rotations[..., 0, 1], rotations[..., 1, 1])
    second = np.arctan2(rotations[..., 2, 1], level)
    third = np.arctan2(-rotations[..., 2, 0], rotations[..., 2, 2])
    locked = level < 1e-7  # gimbal lock: only a sum of the other two angles counts
    first = np.where(locked, np.arctan2(rotations[..., 1, 0], rotations[..., 0, 0]), first)
    angles = np.stack([first, second, np.where(locked, 0.0, third)], axis=-1)
    return np.unwrap(np.degrees(angles), axis=0, period=360.0)
