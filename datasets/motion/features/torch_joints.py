"""`joints_of` in torch, with gradients: for losses and guidance on joints in metres."""

from __future__ import annotations

import torch
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.smpl import BodyModel
from motionloom.datasets.motion.features.running_sum import running_sum
from motionloom.datasets.motion.kinematics import levels
from motionloom.datasets.motion.layout import MotionLayout


def torch_joints_of(features: Tensor, layout: MotionLayout) -> Tensor:
    """Columns [..., T, D] of `layout`, in their own units -> joints [..., T, N, 3] in metres.

    The columns are all of the layout's, or those of its body and hands (`layout.part("bodyhand")`); those of
    no clip's end may follow it. `smplx322` has no network that writes it, and is refused.
    """
    if layout.family == "raw":
        return _posed(features, layout)
    body = layout.without_face()
    if features.shape[-1] == layout.dim != body.dim:
        features = features[..., torch.as_tensor(layout.part("bodyhand"), device=features.device)]
    if features.shape[-1] != body.dim:
        raise UserError(f"layout {layout.name} has {body.dim} columns of body and hands, not these")
    heading, way_x, way_z = torch_way(features, body)
    local = features[..., body.slice("positions")]
    local = local.reshape(*local.shape[:-1], -1, 3)
    x, z = _turned(local[..., 0], local[..., 2], heading[..., None])
    height = features[..., body.slice("root_height")]
    root = torch.stack([way_x[..., None], height, way_z[..., None]], dim=-1)
    others = torch.stack([x + way_x[..., None], local[..., 1], z + way_z[..., None]], dim=-1)
    return torch.cat([root, others], dim=-2)


def torch_way(features: Tensor, layout: MotionLayout) -> tuple[Tensor, Tensor, Tensor]:
    """Heading in radians, x and z of the root in metres, [..., T] each, of columns [..., T, D]."""
    published = layout.family == "h3d"
    heading = _from_zero(features[..., layout.slice("root_yaw_velocity")][..., 0]) * (-2 if published else 1)
    # Of `h3d` a step is seen from the heading of the frame that it leads to.
    steps = features[..., layout.slice("root_xz_velocity")]
    seen = torch.cat([heading[..., 1:], heading[..., -1:]], dim=-1) if published else heading
    x, z = (_from_zero(part) for part in _turned(steps[..., 0], steps[..., 1], seen))
    return heading, x, z


def present_joints(present: Tensor, layout: MotionLayout) -> Tensor:
    """Return which joints clips hold, bool [B, N], by their columns of body and hands, bool [B, D]."""
    if layout.family == "raw":
        return present.new_ones(len(present), layout.num_joints)
    positions = present[:, layout.without_face().slice("positions")][:, ::3]
    return torch.cat([positions.new_ones(len(present), 1), positions], dim=1)


def _turned(x: Tensor, z: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
    """Points of the ground turned to the left by `angle`."""
    cos = angle.cos()
    sin = angle.sin()
    return z * sin + x * cos, z * cos - x * sin


def _from_zero(steps: Tensor) -> Tensor:
    """Sum of the steps before each frame, along the last axis."""
    return torch.cat([torch.zeros_like(steps[..., :1]), running_sum(steps[..., :-1], -1)], dim=-1)


def _posed(motion: Tensor, layout: MotionLayout) -> Tensor:
    """SMPL parameters on the neutral skeleton, in their own axes."""
    import roma

    if not layout.has("pose") or motion.shape[-1] != layout.dim:
        raise UserError(f"layout {layout.name} is not posed with gradients; smpl75 is")
    turns = motion[..., layout.slice("pose")]
    local = roma.rotvec_to_rotmat(turns.reshape(*turns.shape[:-1], -1, 3))
    return torch_smpl_joints(local, motion[..., layout.slice("trans")])


def torch_smpl_joints(local: Tensor, trans: Tensor) -> Tensor:
    """Joints [..., T, 22, 3] of local rotations [..., T, 22 or more, 3, 3] and translations [..., T, 3] in
    metres: the neutral skeleton, in the source's axes.
    """
    body = BodyModel.neutral("smpl22")
    parents = body.skeleton.parents
    rest = body.rest_joints()
    offsets = torch.as_tensor(body.skeleton.bones(rest)).to(local)
    world = {0: local[..., 0, :, :]}
    joints = {0: torch.as_tensor(rest[0]).to(local) + trans}
    for child in (child for level in levels(parents) for child in level):
        above = parents[child]
        world[child] = world[above] @ local[..., child, :, :]
        joints[child] = joints[above] + world[above] @ offsets[child]
    return torch.stack([joints[joint] for joint in range(len(parents))], dim=-2)
