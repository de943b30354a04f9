"""The h3d family against vectors made by the published HumanML3D and HumanTOMATO code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import retarget
from motionloom.datasets.motion.features.codec import decode, encode, face_of
from motionloom.datasets.motion.features.h3d import decode_h3d, encode_h3d, uniform_joints
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError

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


def test_every_column_equals_the_published_features(golden: tuple[dict[str, NDArray], MotionLayout]) -> None:
    arrays, layout = golden
    want = arrays["feat263" if layout.name == "h3d263" else "feat623"]
    ours = encode_h3d(arrays["joints"], layout, arrays["tgt_offsets"])
    assert ours.shape == want.shape == (len(arrays["joints"]) - 1, layout.dim)
    for field, _ in layout.fields:
        columns = layout.slice(field)
        np.testing.assert_allclose(
            ours[:, columns], want[:, columns], rtol=0, atol=ATOL.get(field, 5e-5), err_msg=field
        )


def test_retargeted_and_canonical_joints(golden: tuple[dict[str, NDArray], MotionLayout]) -> None:
    arrays, layout = golden
    skeleton, offsets = layout.skeleton, arrays["tgt_offsets"]
    np.testing.assert_allclose(retarget(arrays["joints"], skeleton, offsets), arrays["uniform"], atol=5e-5)
    np.testing.assert_allclose(
        uniform_joints(arrays["joints"], skeleton, offsets), arrays["global"], atol=5e-5
    )


def test_recovered_joints(golden: tuple[dict[str, NDArray], MotionLayout]) -> None:
    arrays, layout = golden
    want = arrays["feat263" if layout.name == "h3d263" else "feat623"]
    np.testing.assert_allclose(decode_h3d(want, layout), arrays["recovered"], atol=5e-6)


def test_paper_representations_are_slices(golden: tuple[dict[str, NDArray], MotionLayout]) -> None:
    arrays, layout = golden
    name, key = ("body133", "feat133") if layout.name == "h3d263" else ("wholebody313", "feat313")
    small = MotionLayout.named(name, family="h3d")
    ours = encode_h3d(arrays["joints"], small, arrays["tgt_offsets"])
    np.testing.assert_allclose(ours, arrays[key], rtol=0, atol=5e-5)
    np.testing.assert_allclose(decode(ours, small), arrays["recovered"], atol=1e-4)


def test_the_quirks_are_there(shared: Path) -> None:
    with np.load(shared / "golden" / "t1_humanml3d_A.npz", allow_pickle=False) as data:
        joints, offsets = data["aistturn__joints"], data["tgt_offsets"]
        still = data["h3d012314__joints"]
    layout = MotionLayout.named("h3d263")
    yaw = encode_h3d(joints, layout, offsets)[:, 0]
    assert yaw[91] < 0 < yaw[92] and yaw[93] < 0, "where the heading passes 180 degrees the sign is wrong"
    assert encode_h3d(still, layout, offsets)[0, 0] == pytest.approx(0.106, abs=1e-3)
    exact = MotionLayout.named("body133")
    assert np.all(encode(joints.astype(np.float64), exact)[85:100, 0] > 0), "the exact family has no flip"


def test_batches_equal_single_clips_and_the_skeletons_own_bones_are_the_default() -> None:
    rng = np.random.default_rng(0)
    for name in ("h3d263", "tomato623"):
        layout = MotionLayout.named(name)
        sway = np.cumsum(rng.normal(scale=0.01, size=(3, 5, 40, layout.num_joints, 3)), axis=2)
        joints = layout.skeleton.rest_joints + sway
        batch = encode(joints, layout)
        assert batch.shape == (3, 5, 39, layout.dim)
        np.testing.assert_allclose(batch[2, 3], encode(joints[2, 3], layout), atol=1e-6)
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
