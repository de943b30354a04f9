"""Joint maps: positions, units, up axis, and clear errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from motionloom.datasets.motion.bvh.joint_map import JointMap
from motionloom.datasets.motion.bvh.motion import read_bvh
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError


@pytest.fixture
def bandai(shared: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((shared / "data/bandai/joint_map.json").read_text())
    return data


def saved(folder: Path, data: object) -> Path:
    path = folder / "map.json"
    path.write_text(json.dumps(data))
    return path


def test_bandai_map_gives_metres_and_midpoints(shared: Path) -> None:
    joint_map = JointMap.load(shared / "data/bandai/joint_map.json")
    motion = read_bvh(shared / "data/broken/bvh/control_ok.bvh")
    joints = joint_map.apply(motion)
    world = dict(zip(motion.joints, np.moveaxis(motion.positions(), 1, 0), strict=True))
    skeleton = Skeleton.named("smpl22")
    assert joints.shape == (6, 22, 3)
    np.testing.assert_allclose(joints[:, skeleton.index("pelvis")], world["Hips"] * 0.01)
    np.testing.assert_allclose(joints[:, skeleton.index("left_wrist")], world["Hand_L"] * 0.01)
    middle = (world["Hips"] + world["Spine"]) / 2 * 0.01
    np.testing.assert_allclose(joints[:, skeleton.index("spine1")], middle)
    assert joint_map.unmapped == ("joint_Root",)
    upper_leg = joints[:, skeleton.index("left_knee")] - joints[:, skeleton.index("left_hip")]
    np.testing.assert_allclose(np.linalg.norm(upper_leg, axis=-1), 0.3908, atol=1e-4)


def test_units_and_up_axis(shared: Path) -> None:
    joint_map = JointMap.load(shared / "data/bandai/joint_map.json")
    motion = read_bvh(shared / "data/broken/bvh/control_ok.bvh")
    metres = joint_map.apply(motion, unit="m")
    np.testing.assert_allclose(joint_map.apply(motion, unit="mm"), metres / 1000)
    np.testing.assert_allclose(joint_map.apply(motion, unit="inch"), metres * 0.0254)
    z_up = joint_map.apply(motion, unit="m", up="z")
    # z up to y up is a rotation (handedness kept): x stays, z becomes y, y points away.
    turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    assert np.linalg.det(turn) == pytest.approx(1)
    np.testing.assert_allclose(z_up, metres @ turn.T)


def test_errors_name_the_row(tmp_path: Path, bandai: dict[str, Any]) -> None:
    rows = bandai["smpl22"]
    cases: list[tuple[object, str]] = [
        ({"smpl22": rows[1:]}, "no row for pelvis"),
        ({"smpl22": [*rows, rows[0]]}, "'pelvis' appears twice"),
        ({"smpl22": [[3, "pelvis", "Hips"], *rows[1:]]}, "has index 3, not 0"),
        ({"smpl22": [[0, "pelvis", []], *rows[1:]]}, "has no source joint"),
        ({"smpl22": [[0, "tail", "Hips"], *rows[1:]]}, "no joint 'tail'"),
        ({"smpl22": [["pelvis", "Hips"], *rows[1:]]}, "row 0: expected"),
        ({"smpl24": rows}, "key named after the skeleton 'smpl22'; found smpl24"),
        ([], "found no keys"),
    ]
    for data, message in cases:
        with pytest.raises(UserError, match=message):
            JointMap.load(saved(tmp_path, data))
    (tmp_path / "broken.json").write_text("{")
    with pytest.raises(UserError, match="not valid JSON"):
        JointMap.load(tmp_path / "broken.json")
    with pytest.raises(UserError, match="cannot read"):
        JointMap.load(tmp_path / "none.json")


def test_a_joint_the_clip_lacks_is_named_with_the_nearest(
    tmp_path: Path, shared: Path, bandai: dict[str, Any]
) -> None:
    bandai["smpl22"][0][2] = "hips"
    motion = read_bvh(shared / "data/broken/bvh/control_ok.bvh")
    with pytest.raises(UserError, match=r"control_ok.bvh: no joint 'hips'.*did you mean 'Hips'"):
        JointMap.load(saved(tmp_path, bandai)).apply(motion)


def test_an_ambiguous_joint_is_refused(shared: Path) -> None:
    text = (shared / "data/broken/bvh/control_ok.bvh").read_text().replace("JOINT Head", "JOINT Neck")
    joint_map = JointMap.load(shared / "data/bandai/joint_map.json")
    with pytest.raises(UserError, match="'Neck' appears 2 times"):
        joint_map.apply(read_bvh(text, name="twice.bvh"))
