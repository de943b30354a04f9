"""Motion-X's columns against the golden arrays and torch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import roma
import torch

from motionloom.datasets.convert.motionx.convert import parameters_to_joints
from motionloom.datasets.convert.motionx.parameters import RAW, stretch, z_up_to_y_up
from motionloom.datasets.motion.canonical import mirror
from motionloom.datasets.motion.smpl import BodyModel


def test_golden_slices_mirror_and_axes(shared: Path) -> None:
    with np.load(shared / "golden/t4_motionx322_A.npz") as golden:
        values = golden["motion322"].astype(np.float64)
        mirrored, processed = golden["mirrored"].astype(np.float64), golden["processed"].astype(np.float64)
        slices = {name: golden[f"slice_{name}"] for name in (
            "root_orient", "pose_body", "pose_hand", "pose_jaw", "face_expr", "face_shape", "trans", "betas"
        )}  # fmt: skip
    for name, (start, stop) in slices.items():
        assert RAW.slice("face" if name == "face_expr" else name) == slice(start, stop)
    body = BodyModel.neutral("smplx52")
    ours = parameters_to_joints(values, body)
    np.testing.assert_allclose(parameters_to_joints(mirrored, body), mirror(ours, body.skeleton), atol=1e-6)
    turned = z_up_to_y_up(values)
    root = slice(0, 3)
    angle = roma.rotmat_geodesic_distance(*(
        roma.rotvec_to_rotmat(torch.from_numpy(np.ascontiguousarray(v[:, root]))) for v in (turned, processed)
    ))  # fmt: skip
    assert float(angle.max()) < 5e-5  # the golden axis-angles went through float32 matrices
    np.testing.assert_allclose(turned[:, 3:], processed[:, 3:], atol=1e-6)
    # On joints: everything turned about X, but for a constant step.
    upright = ours[..., [0, 2, 1]] * [1, 1, -1]
    away = parameters_to_joints(turned, body) - upright
    assert np.abs(away - away[0, 0]).max() < 1e-9


@pytest.mark.parametrize(("before", "after"), [(72, 50), (50, 72), (1, 5), (7, 1), (4, 4)])
def test_stretch_is_torch_interpolate(before: int, after: int) -> None:
    values = np.random.default_rng(0).standard_normal((before, 3))
    wanted = torch.nn.functional.interpolate(torch.from_numpy(values).T[None], size=after, mode="linear")
    np.testing.assert_allclose(stretch(values, after), wanted[0].T.numpy(), atol=1e-12)
