"""SMPL parameters -> joints: forward kinematics on joints beside the whole body model, in one run.

    python benchmarks/smpl.py [--frames 300] [--threads 1] [--repeats 15]

The body model is made up, but of true size (SMPL 6890 vertices, 24 joints; SMPL-X 10475, 55) and does what
the usual body-model layers do in float32: shape blend, joint regression, pose blend, skinning. HumanML3D
reads its joints from such a layer, frame by frame; here it gets all frames in one batch, which is faster.
Calls take turns, medians are compared. The floor is what no method can do without: one pass over parameters
and joints, and the sine and cosine of every angle.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.datasets.motion.body.smpl import BodyModel, SkeletonName, smpl_joints
from motionloom.datasets.motion.skeleton import Skeleton

SHAPES = 10
CASES: tuple[tuple[str, SkeletonName, int, int], ...] = (
    ("SMPL", "smpl22", 6890, 24),
    ("SMPL-X", "smplx52", 10475, 55),
)
FLOPS_A_JOINT = 2 * 20 + 30 + 45 + 18
"""Sine and cosine, rotation matrix, one 3 x 3 product, one turned bone."""


@dataclass(frozen=True)
class MeshModel:
    """A body model with random content of the published sizes."""

    template: Tensor
    shapes: Tensor
    poses: Tensor
    regressor: Tensor
    weights: Tensor
    parents: list[int]

    @staticmethod
    def made_up(skeleton: Skeleton, vertices: int, joints: int) -> MeshModel:
        generator = torch.Generator().manual_seed(0)
        # Joints beyond the skeleton's (hands of SMPL; jaw and eyes of SMPL-X) are leaves: any parent will do.
        parents = [*skeleton.parents, *[0] * (joints - len(skeleton))]
        regressor = torch.zeros(joints, vertices)
        for joint in range(joints):  # about 30 vertices a joint, as in the published regressors
            chosen = torch.randint(vertices, (30,), generator=generator)
            regressor[joint, chosen] = torch.rand(30, generator=generator)
        regressor /= regressor.sum(dim=1, keepdim=True)
        weights = torch.rand(vertices, joints, generator=generator) ** 20
        return MeshModel(
            template=torch.randn(vertices, 3, generator=generator),
            shapes=0.01 * torch.randn(vertices, 3, SHAPES, generator=generator),
            poses=0.001 * torch.randn(9 * (joints - 1), 3 * vertices, generator=generator),
            regressor=regressor,
            weights=weights / weights.sum(dim=1, keepdim=True),
            parents=parents,
        )

    @torch.no_grad()
    def __call__(self, rotvecs: Tensor, trans: Tensor, betas: Tensor) -> tuple[Tensor, Tensor]:
        """Vertices [T, V, 3] and joints [T, J, 3] of rotvecs [T, J, 3], trans [T, 3] and betas [T, B]."""
        frames, joints = rotvecs.shape[:2]
        shaped = self.template + torch.einsum("tb,vcb->tvc", betas, self.shapes)
        rest = torch.einsum("jv,tvc->tjc", self.regressor, shaped)
        local = axis_angle_matrices(rotvecs)
        blend = (local[:, 1:] - torch.eye(3)).reshape(frames, -1) @ self.poses
        posed = shaped + blend.reshape(frames, -1, 3)
        bones = rest.clone()
        bones[:, 1:] -= rest[:, self.parents[1:]]
        steps = torch.zeros(frames, joints, 4, 4)
        steps[:, :, :3, :3], steps[:, :, :3, 3], steps[:, :, 3, 3] = local, bones, 1.0
        chain = [steps[:, 0]]
        for joint in range(1, joints):
            chain.append(chain[self.parents[joint]] @ steps[:, joint])
        world = torch.stack(chain, dim=1)
        moves = world.clone()
        moves[:, :, :3, 3] -= torch.einsum("tjik,tjk->tji", world[:, :, :3, :3], rest)
        skin = (self.weights @ moves.reshape(frames, joints, 16)).reshape(frames, -1, 4, 4)
        padded = torch.cat([posed, torch.ones(frames, posed.shape[1], 1)], dim=2)
        vertices = (skin @ padded[..., None])[:, :, :3, 0] + trans[:, None]
        return vertices, world[:, :, :3, 3] + trans[:, None]

    def reduced(self, skeleton: Skeleton, mine: list[int]) -> BodyModel:
        """The same body for `smpl_joints`."""
        regressor = self.regressor.double().numpy()[mine]
        template = regressor @ self.template.double().numpy()
        directions = np.tensordot(regressor, self.shapes.double().numpy(), axes=1)
        return BodyModel(skeleton, template, directions, {})


def axis_angle_matrices(rotvecs: Tensor) -> Tensor:
    """Rotation matrices [T, J, 3, 3]."""
    angle = torch.linalg.norm(rotvecs, dim=-1, keepdim=True)[..., None].clamp_min(1e-8)
    x, y, z = (rotvecs / angle[..., 0]).unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*x.shape, 3, 3)
    matrices: Tensor = torch.eye(3) + angle.sin() * cross + (1 - angle.cos()) * (cross @ cross)
    return matrices


def interleaved_medians(calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median milliseconds of each call; calls take turns, so a slow phase of the machine hits all of them."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for i in range(repeats + 2):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            if i >= 2:
                times[name].append(1000 * (time.perf_counter() - start))
    return {name: statistics.median(values) for name, values in times.items()}


def floor(rotvecs: NDArray[np.float64], joints: NDArray[np.float64]) -> None:
    angle = rotvecs[..., 0] + rotvecs[..., 1] + rotvecs[..., 2]
    np.sin(angle)
    np.cos(angle)
    np.copyto(joints, rotvecs)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=15)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    rng = np.random.default_rng(0)
    for name, skeleton_name, vertices, count in CASES:
        skeleton = Skeleton.named(skeleton_name)
        model = MeshModel.made_up(skeleton, vertices, count)
        mine = list(range(len(skeleton)))
        body = model.reduced(skeleton, mine)
        rotvecs, trans = rng.normal(size=(args.frames, count, 3)), rng.normal(size=(args.frames, 3))
        betas = rng.normal(size=SHAPES)
        ours = np.ascontiguousarray(rotvecs[:, mine])
        theirs = [torch.from_numpy(a).float() for a in (rotvecs, trans, np.tile(betas, (args.frames, 1)))]
        joints = smpl_joints(ours, trans, body, betas)
        error = np.abs(model(*theirs)[1].numpy()[:, mine] - joints).max()
        space = np.empty_like(joints)
        times = interleaved_medians(
            {
                "mesh": lambda m=model, t=theirs: m(*t),  # type: ignore[misc]
                "joints": lambda o=ours, t=trans, b=body, s=betas: smpl_joints(o, t, b, s),  # type: ignore[misc]
                "floor": lambda o=ours, s=space: floor(o, s),  # type: ignore[misc]
            },
            args.repeats,
        )
        points = ours.shape[0] * ours.shape[1]
        print(
            f"{name:7} {args.frames} frames, {vertices} vertices x {count} joints: through the mesh "
            f"{times['mesh']:.0f} ms, joints alone {times['joints']:.2f} ms, "
            f"{times['mesh'] / times['joints']:.0f} times faster; floor {times['floor']:.2f} ms "
            f"({48e-6 * points:.2f} MB, {1e-6 * FLOPS_A_JOINT * points:.2f} MFLOP); largest difference "
            f"{error:.1e} m"
        )


if __name__ == "__main__":
    main()
