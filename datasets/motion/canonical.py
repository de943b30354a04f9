"""Canonical joints: heading, canonical pose, resampling in time, mirroring, retargeting.

Joints are metres, Y up, right handed: a figure that faces +Z has its left side at +X. A heading is an angle
about Y in radians: 0 is +Z, positive is a turn to the left (towards +X, counter-clockwise seen from above).

Choices:
- The ground plane is one complex number a point, `z + i x`, so that turning by a heading is one
  multiplication by `exp(i heading)`.
- The smoothed heading keeps its first and last value: canonical joints therefore start at heading 0 both raw
  and smoothed, which is what makes the exact features invertible (HumanML3D forces frame 0 instead and leaves
  a jump).
- Angles are smoothed after unwrapping, not as vectors: vectors cancel out when somebody spins within the
  window.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.skeleton import Skeleton

Float = TypeVar("Float", bound=np.floating)

SMOOTH_SECONDS = 1.0
"""Standard deviation of the heading's Gaussian: HumanML3D's 20 frames at 20 fps."""

_NAMED = Skeleton.named("smpl22")
LEFT_HIP, RIGHT_HIP = _NAMED.index("left_hip"), _NAMED.index("right_hip")
LEFT_SHOULDER, RIGHT_SHOULDER = _NAMED.index("left_shoulder"), _NAMED.index("right_shoulder")
_LEG = (_NAMED.index("right_knee"), _NAMED.index("right_ankle"))


def ground(joints: NDArray[np.floating]) -> NDArray[np.complex128]:
    """`z + i x` of points [..., 3] -> complex [...]; multiplying by `exp(i a)` turns them left by `a`."""
    plane = np.empty_like(joints[..., 0], dtype=np.complex128)
    plane.real = joints[..., 2]
    plane.imag = joints[..., 0]
    return plane


def facing(joints: NDArray[np.floating]) -> NDArray[np.float64]:
    """Raw heading of every frame: joints [..., T, N, 3] -> radians [..., T], unwrapped along T.

    The direction is perpendicular to hips plus shoulders. Frames where these have no horizontal extent (a
    figure that lies on its side) keep the heading of the last frame that had one.
    """
    side = ground(joints[..., [RIGHT_HIP, RIGHT_SHOULDER, LEFT_HIP, LEFT_SHOULDER], :])
    across = side[..., 0] + side[..., 1] - side[..., 2] - side[..., 3]
    angle = np.angle(1j * across)
    known = np.abs(across) > 1e-6
    if not known.all():
        angle = _hold(angle, known)
    return np.unwrap(angle, axis=-1)


def _hold(values: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Replace unknown frames by the last known one, leading ones by the first known; 0 without any."""
    frames = np.arange(values.shape[-1])
    first = np.argmax(known, axis=-1)[..., None]
    source = np.maximum.accumulate(np.where(known, frames, first), axis=-1)
    held = np.take_along_axis(values, source, axis=-1)
    return np.where(known.any(axis=-1, keepdims=True), held, 0.0)


def heading(joints: NDArray[np.floating], fps: float) -> NDArray[np.float64]:
    """Smoothed heading: joints [..., T, N, 3] -> radians [..., T], unwrapped (a full turn left is 2 pi).

    Gaussian of `SMOOTH_SECONDS`, extended by point reflection at both ends, so that the first and the last
    frame keep their raw heading and a steady turn is reproduced without lag.
    """
    from scipy.ndimage import gaussian_filter1d

    angle = facing(joints)
    last = angle.shape[-1] - 1
    if last < 1:
        return angle
    # Point reflection at both ends: a straight line, which a Gaussian leaves alone, plus a periodic odd rest.
    line = np.linspace(angle[..., 0], angle[..., -1], last + 1, axis=-1)
    rest = angle - line
    period = np.concatenate([rest[..., :-1], -rest[..., :0:-1]], axis=-1)
    smooth = gaussian_filter1d(period, SMOOTH_SECONDS * fps, axis=-1, mode="wrap")
    return np.asarray(line + smooth[..., : last + 1], dtype=np.float64)


def canonicalize(joints: NDArray[Float]) -> NDArray[Float]:
    """Move a clip [..., T, N, 3] to the canonical place; the float type is kept.

    Floor (lowest joint of all frames) at y = 0, first root above the origin, first heading +Z.
    """
    kind = np.result_type(joints, np.float32)
    out = np.array(joints, dtype=np.float64)
    out[..., 1] -= out[..., 1].min(axis=(-2, -1), keepdims=True)
    plane = ground(out)
    plane = (plane - plane[..., :1, :1]) * np.exp(-1j * facing(out[..., :1, :, :]))[..., None]
    out[..., 2] = plane.real
    out[..., 0] = plane.imag
    return out.astype(kind, copy=False)


def mirror(joints: NDArray[Float], skeleton: Skeleton) -> NDArray[Float]:
    """Mirror image of joints [..., N, 3]: left and right swapped, x negated."""
    skeleton.require_joints(joints)
    mirrored: NDArray[Float] = joints[..., skeleton.mirror, :] * np.array([-1, 1, 1], dtype=joints.dtype)
    return mirrored


MOST_STRETCH = 100
"""Frames that one frame becomes at most: 240 a second are made of 2.4 [ours]."""


_MOST_TIMES, _ANYWAY = 3, 2400
"""Frames that a file may become for each that it has, and others that it may: two minutes [ours]."""


def require_rate(frames: int, fps: float, wanted: float) -> None:
    """`UserError` where so many frames, at the rate that a file states, are too few for the wanted one: a few
    bytes would become hours of motion that nobody has recorded.
    """
    if frames * wanted > fps * (_MOST_TIMES * frames + _ANYWAY):
        raise UserError(
            f"{frames:,} frames at {fps:.3g} a second, {frames / fps / 60:.0f} min, are too few for "
            f"{wanted:g} a second; is the frame rate right?"
        )


def resample(values: NDArray[Float], fps_in: float, fps_out: float) -> NDArray[Float]:
    """Linear resampling in time of [T, ...] from one frame rate to another; frame 0 stays at time 0.

    Frames that fall on input frames (30 from 60 fps) are taken as they are. The result ends at or before the
    last input frame. Not for rotations: `resample_quaternions`.
    """
    left, weight = _source_frames(len(values), fps_in, fps_out)
    kind = np.result_type(values, np.float32)
    if not weight.any():
        return values[left].astype(kind, copy=False)
    right = np.minimum(left + 1, len(values) - 1)
    weight = weight.reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray((1.0 - weight) * values[left] + weight * values[right], dtype=kind)


def resample_quaternions(
    quaternions: NDArray[np.floating], fps_in: float, fps_out: float
) -> NDArray[np.float64]:
    """Spherical resampling in time of unit quaternions [T, ..., 4] (x, y, z, w), along the shorter arc."""
    import roma
    import torch

    left, weight = _source_frames(len(quaternions), fps_in, fps_out)
    right = np.minimum(left + 1, len(quaternions) - 1)
    unit = roma.quat_normalize(torch.from_numpy(np.asarray(quaternions, dtype=np.float64)))
    start = unit[torch.from_numpy(left)]
    end = unit[torch.from_numpy(right)]
    start = start.reshape(-1, 4)
    end = end.reshape(-1, 4)
    # roma's slerp takes one list of steps for all pairs; here each frame has its own, so the arc is scaled.
    arc = roma.unitquat_to_rotvec(roma.quat_product(roma.quat_conjugation(start), end), shortest_arc=True)
    step = torch.from_numpy(weight).repeat_interleave(len(start) // len(left))
    out = roma.quat_product(start, roma.rotvec_to_unitquat(arc * step[:, None]))
    shape = (len(left), *quaternions.shape[1:])
    return np.asarray(roma.quat_normalize(out).reshape(shape).numpy(), dtype=np.float64)


def _source_frames(
    frames: int, fps_in: float, fps_out: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """For every output frame the input frame at or before it, and the fraction of the way to the next."""
    if fps_in <= 0 or fps_out <= 0:
        raise UserError(f"frame rates must be positive, not {fps_in} and {fps_out}")
    if frames == 0:
        raise UserError("a clip without frames cannot be resampled")
    if fps_out > MOST_STRETCH * fps_in:  # a minute a frame in a header would fill the memory
        raise UserError(f"{fps_in:.3g} frames a second are too few for {fps_out:g}; is the frame rate right?")
    count = int(np.floor((frames - 1) * fps_out / fps_in + 1e-6)) + 1
    at = np.arange(count) * fps_in / fps_out
    whole = np.round(at)
    at = np.where(np.abs(at - whole) < 1e-6, whole, at)
    left = np.minimum(np.floor(at).astype(np.int64), frames - 1)
    return left, np.clip(at - left, 0.0, 1.0)


def runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the start and the end (exclusive) of each run of true of flags [T]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def retarget(
    joints: NDArray[np.floating], skeleton: Skeleton, offsets: NDArray[np.floating] | None = None
) -> NDArray[np.float64]:
    """One uniform skeleton (HumanTOMATO's H3D-Format): joints [..., T, N, 3] -> the same poses with given
    bones.

    Every bone keeps its direction and takes the length of `offsets` [N, 3] (metres, default the skeleton's
    own); the root path is scaled by the ratio of leg lengths, measured in the first frame. A bone without
    length in the source keeps none, since it has no direction.
    """
    skeleton.require_joints(joints)
    lengths = np.linalg.norm(skeleton.offsets if offsets is None else offsets, axis=-1)
    # Joint-first in memory ([3, N, ..., T], time contiguous): four times faster, and h3d goes on like this.
    points = np.array(np.moveaxis(joints, (-1, -2), (0, 1)), dtype=np.float64, order="C")
    bones = points[:, 1:] - points[:, list(skeleton.parents[1:])]
    size = np.sqrt(bones[0] ** 2 + bones[1] ** 2 + bones[2] ** 2)
    leg = size[[joint - 1 for joint in _LEG], ..., :1].sum(axis=0)
    points[:, 0] *= np.where(leg > 0, lengths[list(_LEG)].sum() / np.where(leg > 0, leg, 1.0), 1.0)
    bones *= lengths[1:].reshape(-1, *(1,) * (size.ndim - 1)) / np.where(size > 0, size, 1.0)
    for joint, parent in enumerate(skeleton.parents[1:], start=1):
        np.add(points[:, parent], bones[:, joint - 1], out=points[:, joint])
    return np.moveaxis(points, (0, 1), (-1, -2))
