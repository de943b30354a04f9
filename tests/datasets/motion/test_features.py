"""Both families of features, against round trips and the published code, and the joints of any columns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.canonical import canonicalize, ground, retarget
from motionloom.datasets.motion.features.codec import decode, encode, face_of
from motionloom.datasets.motion.features.h3d import encode_h3d, uniform_joints
from motionloom.datasets.motion.features.joints import joints_of, local_joints_of
from motionloom.datasets.motion.features.torch_joints import present_joints, torch_joints_of
from motionloom.datasets.motion.layout import LAYOUTS, MotionLayout
from motionloom.datasets.synth.generate import SynthConfig, make_clip, make_sample

BODY = MotionLayout.named("body133")


def turn(joints: NDArray, angle: float) -> NDArray:
    """Points turned left about the Y axis."""
    return joints @ Rotation.from_rotvec([0, angle, 0]).as_matrix().T


def clip(layout: MotionLayout, frames: int, turns: float, seed: int = 0) -> NDArray[np.float64]:
    """A swaying figure [T, N, 3] that turns left `turns` times, unevenly, while its root wanders."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames) / layout.fps
    shape = (layout.num_joints, 3)
    sway = 0.06 * np.sin(rng.uniform(1, 9, shape) * time[:, None, None] + rng.uniform(0, 6, shape))
    joints = layout.skeleton.rest_joints + sway
    angle = 2 * np.pi * turns * np.linspace(0, 1, frames) + 0.3 * np.sin(3 * time)
    plane = ground(joints) * np.exp(1j * angle)[:, None]
    plane += (1.5 * time * np.exp(1j * rng.uniform(0, 6)) + np.sin(time))[:, None]
    joints[..., 2], joints[..., 0] = plane.real, plane.imag
    return canonicalize(joints)


@given(
    name=st.sampled_from(["body133", "wholebody313", "wholebody363"]),
    fps=st.sampled_from([20.0, 30.0, 60.0]),
    turns=st.floats(-4, 4),
    seed=st.integers(0, 2**31 - 1),
)
@settings(max_examples=25, deadline=None)
def test_ten_seconds_come_back_within_a_tenth_of_a_millimetre(
    name: str, fps: float, turns: float, seed: int
) -> None:
    layout = MotionLayout.named(name, fps=fps)
    joints = clip(layout, int(10 * fps), turns, seed)
    features = encode(joints, layout)
    assert features.shape == (len(joints), layout.dim)
    assert features.dtype == np.float32
    assert np.abs(decode(features, layout) - joints).max() < 1e-4


def test_columns_of_a_circle_to_the_left() -> None:
    """Forward speed in z, none in x, a constant yaw, a still pose, one root velocity."""
    frames, rate, speed = 100, 0.05, 0.04
    angle = rate * np.arange(frames)
    plane = ground(BODY.skeleton.rest_joints) * np.exp(1j * angle)[:, None]
    plane += np.concatenate([[0], np.cumsum(speed * np.exp(1j * angle))[:-1]])[:, None]
    joints = np.empty((frames, 22, 3))
    joints[..., 2], joints[..., 0] = plane.real, plane.imag
    joints[..., 1] = BODY.skeleton.rest_joints[:, 1] + 0.9
    features = encode(joints, BODY)
    np.testing.assert_allclose(features[:, BODY.slice("root_yaw_velocity")], rate, atol=1e-6)
    np.testing.assert_allclose(features[:, BODY.slice("root_xz_velocity")], [[0, speed]] * frames, atol=1e-6)
    np.testing.assert_allclose(features[:, BODY.slice("root_height")], 0.9, atol=1e-6)
    still = BODY.skeleton.rest_joints[1:] + np.array([0, 0.9, 0])
    np.testing.assert_allclose(features[:, BODY.slice("positions")], [still.ravel()] * frames, atol=1e-6)
    root = features[:, BODY.slice("velocities")][:, :3]
    np.testing.assert_allclose(root, [[0, 0, speed]] * frames, atol=1e-6)


def test_float32_joints_a_collapsed_figure_and_few_frames() -> None:
    joints = clip(BODY, 200, 2.0).astype(np.float32)
    assert np.abs(decode(encode(joints, BODY), BODY) - joints).max() < 1e-4
    np.testing.assert_array_equal(encode(np.zeros((5, 22, 3)), BODY), 0.0)
    for frames in (1, 2, 3):
        few = joints[:frames]
        np.testing.assert_allclose(decode(encode(few, BODY), BODY), few, atol=1e-5)


def test_face_columns() -> None:
    layout = MotionLayout.named("wholebody363")
    joints = clip(layout, 20, 0.0)
    face = np.random.default_rng(0).normal(size=(20, 50)).astype(np.float32)
    features = encode(joints, layout, face)
    np.testing.assert_array_equal(face_of(features, layout), face)
    np.testing.assert_array_equal(face_of(encode(joints, layout), layout), 0.0)
    np.testing.assert_array_equal(features[:, :313], encode(joints, layout)[:, :313])
    with pytest.raises(UserError, match=r"face of shape \[19, 50\]"):
        encode(joints, layout, face[:-1])
    with pytest.raises(UserError, match="face"):
        encode(clip(BODY, 20, 0.0), BODY, face)


def test_errors_name_the_layout_and_the_fix() -> None:
    joints = clip(BODY, 20, 0.0)
    with pytest.raises(UserError, match=r"wholebody313.*T, 52, 3\]"):
        encode(joints, MotionLayout.named("wholebody313"))
    with pytest.raises(UserError, match="only the h3d family"):
        encode(joints, MotionLayout.named("h3d263", family="exact"))
    with pytest.raises(UserError, match="raw parameters"):
        encode(joints, MotionLayout.named("smpl75"))
    with pytest.raises(UserError, match="family 'raw'"):
        encode(joints, MotionLayout.named("body133", family="raw"))
    with pytest.raises(UserError, match="has 133 columns"):
        decode(np.zeros((5, 263)), BODY)
    with pytest.raises(UserError, match="too short"):
        encode(joints[:0], BODY)
    joints[3, 4, 1] = np.nan
    with pytest.raises(UserError, match="NaN"):
        encode(joints, BODY)


CASES = [
    ("t1_humanml3d_A.npz", "h3d012314", "h3d263"),
    ("t1_humanml3d_A.npz", "aist", "h3d263"),
    ("t1_humanml3d_A.npz", "aistturn", "h3d263"),
    ("t2_tomato_clean_A.npz", "aistsyn", "tomato623"),
]
ATOL = {"rotations_6d": 1e-4, "root_yaw_velocity": 1e-6, "foot_contacts": 0.0}


@pytest.fixture(params=CASES, ids=[case[1] for case in CASES])
def golden(request: pytest.FixtureRequest, shared: Path) -> tuple[dict[str, NDArray], MotionLayout]:
    file, key, name = request.param
    with np.load(shared / "golden" / file, allow_pickle=False) as data:
        arrays = {k.removeprefix(f"{key}__"): data[k] for k in data.files if k.startswith(f"{key}__")}
        arrays["tgt_offsets"] = data["tgt_offsets"]
    return arrays, MotionLayout.named(name)


def test_joints_and_columns_equal_the_published_ones(golden: tuple[dict[str, NDArray], MotionLayout]) -> None:
    arrays, layout = golden
    joints, skeleton, offsets = arrays["joints"], layout.skeleton, arrays["tgt_offsets"]
    np.testing.assert_allclose(retarget(joints, skeleton, offsets), arrays["uniform"], atol=5e-5)
    np.testing.assert_allclose(uniform_joints(joints, skeleton, offsets), arrays["global"], atol=5e-5)
    want = arrays["feat263" if layout.name == "h3d263" else "feat623"]
    ours = encode_h3d(joints, layout, offsets)
    assert ours.shape == want.shape == (len(joints) - 1, layout.dim)
    for field, _ in layout.fields:
        columns = layout.slice(field)
        np.testing.assert_allclose(
            ours[:, columns], want[:, columns], rtol=0, atol=ATOL.get(field, 5e-5), err_msg=field
        )
    np.testing.assert_allclose(decode(want, layout), arrays["recovered"], atol=5e-6)


def test_paper_representations_are_slices(golden: tuple[dict[str, NDArray], MotionLayout]) -> None:
    arrays, layout = golden
    name, key = ("body133", "feat133") if layout.name == "h3d263" else ("wholebody313", "feat313")
    small = MotionLayout.named(name, family="h3d")
    ours = encode_h3d(arrays["joints"], small, arrays["tgt_offsets"])
    np.testing.assert_allclose(ours, arrays[key], rtol=0, atol=5e-5)
    np.testing.assert_allclose(decode(ours, small), arrays["recovered"], atol=1e-4)


def test_batches_equal_single_clips_and_the_skeletons_own_bones_are_the_default() -> None:
    rng = np.random.default_rng(0)
    for name in ("h3d263", "tomato623", "wholebody363"):
        layout = MotionLayout.named(name)
        sway = np.cumsum(rng.normal(scale=0.01, size=(3, 5, 40, layout.num_joints, 3)), axis=2)
        joints = layout.skeleton.rest_joints + sway
        batch = encode(joints, layout)
        assert batch.shape == (3, 5, 40 - (layout.family == "h3d"), layout.dim)
        np.testing.assert_allclose(batch[2, 3], encode(joints[2, 3], layout), atol=1e-6)
        if layout.family == "h3d":
            own = encode_h3d(joints[2, 3], layout, layout.skeleton.offsets)
            np.testing.assert_array_equal(encode(joints[2, 3], layout), own)
        np.testing.assert_allclose(decode(batch, layout)[1, 2], decode(batch[1, 2], layout), atol=1e-9)


def test_degenerate_bones_stay_finite() -> None:
    layout = MotionLayout.named("tomato623")
    assert np.isfinite(encode(np.zeros((6, 52, 3)), layout)).all()
    upside_down = np.repeat(-layout.skeleton.rest_joints[None], 6, axis=0)
    features = encode(upside_down, layout)
    sixd = features[:, layout.slice("rotations_6d")].reshape(-1, 2, 3)
    np.testing.assert_allclose(np.linalg.norm(sixd, axis=-1), 1.0, atol=1e-5)
    np.testing.assert_allclose((sixd[:, 0] * sixd[:, 1]).sum(-1), 0.0, atol=1e-5)


def test_a_face_loses_the_last_frame_and_one_frame_is_too_short() -> None:
    layout = MotionLayout.named("wholebody363", family="h3d")
    joints = np.repeat(layout.skeleton.rest_joints[None], 9, axis=0)
    face = np.arange(9 * 50, dtype=np.float32).reshape(9, 50)
    features = encode(joints, layout, face)
    assert features.shape == (8, 363)
    np.testing.assert_array_equal(face_of(features, layout), face[:-1])
    with pytest.raises(UserError, match="too short"):
        encode(joints[:1], layout)


@pytest.mark.parametrize("name", LAYOUTS)
def test_without_face_is_the_layout_of_the_body_and_hand_columns(name: str) -> None:
    layout = MotionLayout.named(name, fps=12.5)
    if layout.family == "raw" and layout.has("face"):
        with pytest.raises(UserError, match="face"):
            layout.without_face()
        return
    bare, columns = layout.without_face(), layout.part("bodyhand")
    assert (bare.dim, bare.fps, bare.family) == (len(columns), 12.5, layout.family)
    assert bare.skeleton_name == layout.skeleton_name and not bare.has("face")
    numbers = np.arange(layout.dim)
    for field, _ in bare.fields:  # the same columns under the same name
        np.testing.assert_array_equal(numbers[columns][bare.slice(field)], numbers[layout.slice(field)])
    assert (bare is layout) == (not layout.has("face"))


@pytest.mark.parametrize("name", ["body133", "wholebody313", "wholebody363", "smpl75"])
def test_columns_give_back_the_joints(name: str) -> None:
    config = SynthConfig(clips=3, seed=5, layout=name, fps=20, actions=["walk", "turn", "dance"])  # type: ignore[arg-type]
    layout = config.motion_layout
    for i in range(3):
        motion, joints = make_sample(i, config).motion, make_clip(i, config).joints
        found = joints_of(motion, layout)
        # Single precision, added up over a clip by the velocities of the root; rotations pose each frame.
        np.testing.assert_allclose(found, joints, atol=2e-6 if layout.family == "raw" else 2e-4)
        np.testing.assert_array_equal(joints_of(motion[:, layout.part("bodyhand")], layout), found)


def test_columns_that_do_not_fit_are_refused() -> None:
    with pytest.raises(UserError, match=r"smpl75 has 75.*\[4, 74\]"):
        joints_of(np.zeros((4, 74)), MotionLayout.named("smpl75"))
    raw = MotionLayout.named("smplx322")
    with pytest.raises(UserError, match="322"):
        joints_of(np.zeros((4, len(raw.part("bodyhand")))), raw)


def test_a_pose_does_not_depend_on_place_and_heading() -> None:
    """Against the positions that exact features hold, and of the same motion elsewhere."""
    config = SynthConfig(clips=1, layout="body133", actions=["turn"])
    layout, motion = config.motion_layout, make_sample(0, config).motion
    joints = joints_of(motion, layout)
    local = local_joints_of(joints, layout.fps)
    positions = motion[:, layout.slice("positions")].reshape(len(motion), -1, 3).astype(np.float64)
    positions[..., 1] -= motion[:, layout.slice("root_height")]
    np.testing.assert_allclose(local[:, 1:], positions, atol=2e-4)
    elsewhere = turn(joints, 1.1) + np.array([3.0, 0.5, -2.0])
    np.testing.assert_allclose(local_joints_of(elsewhere, layout.fps), local, atol=1e-9)


# Joints in torch: those of numpy, of every layout that a network writes, and with gradients.

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
