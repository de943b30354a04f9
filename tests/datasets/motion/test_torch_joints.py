"""Joints in torch: those of numpy, of every layout that a network writes, and with gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.features.torch_joints import present_joints, torch_joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError

NAMES = ("body133", "wholebody313", "wholebody363", "h3d263", "tomato623", "smpl75")


@pytest.mark.parametrize("name", NAMES)
def test_they_are_those_of_numpy_and_have_gradients(name: str) -> None:
    layout = MotionLayout.named(name)
    values = np.random.default_rng(0).normal(size=(2, 30, layout.dim)) * 0.4
    features = torch.from_numpy(values).requires_grad_()
    joints = torch_joints_of(features, layout)
    np.testing.assert_allclose(joints.detach().numpy(), joints_of(values, layout), rtol=0, atol=1e-9)
    body = torch.from_numpy(values[..., layout.part("bodyhand")])
    torch.testing.assert_close(torch_joints_of(body, layout), joints.detach())

    # The slope along one direction, by differences of float64.
    aim = torch.randn(joints.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (joints * aim).sum().backward()
    assert features.grad is not None
    step = 1e-6 * torch.randn(features.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    ahead, behind = (torch_joints_of(features.detach() + sign * step, layout) for sign in (1, -1))
    slope = float(((ahead - behind) * aim).sum() / 2)
    assert float((features.grad * step).sum()) == pytest.approx(slope, rel=1e-5, abs=1e-10)


def test_joints_that_a_clip_holds_and_layouts_that_have_none() -> None:
    layout = MotionLayout.named("wholebody363")
    present = torch.from_numpy(layout.present_columns[:, layout.part("bodyhand")])
    assert present_joints(present, layout).sum(1).tolist() == [22, 52, 22, 52]
    assert present_joints(torch.ones(1, 75, dtype=torch.bool), MotionLayout.named("smpl75")).sum() == 22
    for name, dim in (("wholebody363", 50), ("smplx322", 322)):
        with pytest.raises(UserError, match=name):
            torch_joints_of(torch.zeros(2, 5, dim), MotionLayout.named(name))
