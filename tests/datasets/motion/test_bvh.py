"""BVH reader and writer, with an independent library as the oracle; joint maps."""

from __future__ import annotations

import json
import re
import tarfile
from pathlib import Path
from typing import Any

import bvhio
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.bvh.joint_map import JointMap
from motionloom.datasets.motion.bvh.motion import BvhMotion, read_bvh, write_bvh
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.skeleton import Skeleton

TINY = """HIERARCHY
ROOT hips
{
  OFFSET 0 10 0
  CHANNELS 6 Zposition Xposition Yposition Yrotation Xrotation Zrotation
  JOINT upper arm
  {
    OFFSET 1 2 3
    CHANNELS 1 Xrotation
    JOINT hand {
      OFFSET 0 0 4
      CHANNELS 4 Yposition Zrotation Yrotation Xrotation
      End Site
      {
        OFFSET 0 0 1
      }
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0333
1 2 3 10 20 30 40 5 50 60 70
-1 -2 -3 -10 -20 -30 -40 -5 -50 -60 -70
"""


def euler(order: str, *degrees: float) -> np.ndarray:
    return np.asarray(Rotation.from_euler(order, degrees, degrees=True).as_matrix().reshape(3, 3))


def test_what_stands_around_the_text_changes_nothing(shared: Path) -> None:
    folder = shared / "data/broken/bvh"
    control, data = read_bvh(folder / "control_ok.bvh"), (folder / "control_ok.bvh").read_bytes()
    assert (control.fps, control.frames, len(control.joints)) == (30.0, 6, 22)
    padded = (data + end for end in (b"\x1a", b"\r\n\x1a", b"\n\0" + bytes(500), b"\0\n"))
    miscounted = (data.replace(b"Frames:\t6", b"Frames: %d" % count) for count in (5, 7))
    for text in (folder / "crlf_bom.bvh", *padded, *miscounted):
        other = read_bvh(text)
        assert other.joints == control.joints
        np.testing.assert_array_equal(other.values, control.values)
        np.testing.assert_array_equal(other.offsets, control.offsets)


def test_whole_clip_agrees_with_an_independent_reader(shared: Path, tmp_path: Path) -> None:
    path = tmp_path / "clip.bvh"
    with tarfile.open(shared / "data/bandai/dataset-1.tar.xz", "r|*") as archive:
        member = next(m for m in archive if m.name.endswith("bow_active_001.bvh"))
        file = archive.extractfile(member)
        assert file is not None
        path.write_bytes(file.read())
    motion = read_bvh(path)
    assert motion.frames == 128
    np.testing.assert_allclose(motion.positions()[::16], bvhio_positions(path, range(0, 128, 16)), atol=2e-3)


def test_any_channels_in_any_order() -> None:
    motion = read_bvh(TINY)
    assert motion.joints == ("hips", "upper arm", "hand")
    assert motion.parents == (-1, 0, 1)
    assert motion.fps == 30.0
    for frame, sign in enumerate((1, -1)):
        hips = euler("YXZ", *(sign * np.array([10, 20, 30])))
        arm = euler("X", sign * 40)
        hand = euler("ZYX", *(sign * np.array([50, 60, 70])))
        expected = np.zeros((3, 3))
        expected[0] = sign * np.array([2, 3, 1])
        expected[1] = expected[0] + hips @ [1, 2, 3]
        expected[2] = expected[1] + hips @ arm @ [0, sign * 5, 4]
        np.testing.assert_allclose(motion.positions()[frame], expected, atol=1e-12)
        turns = motion.local_rotations(range(3))[:, frame]
        np.testing.assert_allclose(turns, [hips, arm, hand], atol=1e-12)
    np.testing.assert_array_equal(motion.offsets, [[0, 10, 0], [1, 2, 3], [0, 0, 4]])


@pytest.mark.parametrize(
    ("written", "expected"), [("0", [1, 2, 3]), ("7", [7, 0, 0])], ids=["filled with zeros", "filled"]
)
def test_six_channels_on_every_joint(written: str, expected: list[float]) -> None:
    """Position channels of a joint that no frame fills leave its OFFSET, whatever others do."""
    six = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    text = TINY.replace("CHANNELS 1 Xrotation", six)
    rows = "1 2 3 10 20 30 {} 0 0 40 0 0 5 50 60 70\n-1 -2 -3 -10 -20 -30 {} 0 0 -40 0 0 6 -50 -60 -70\n"
    motion = read_bvh(text[: text.index("1 2 3 10")] + rows.format(written, written))
    assert motion.local_offsets()[:, 1:].tolist() == [[expected, [0, 5, 4]], [expected, [0, 6, 4]]]


@pytest.mark.parametrize(
    ("text", "fps"),
    [
        ("0.0333333", 30),
        ("0.0333", 30),
        ("0.033367", 1 / 0.033367),
        ("0.008333333333333333", 120),
        ("1", 1),
        ("0.0083333333333333333333333333333333333", 120),
    ],
)
def test_frame_rate_is_what_the_digits_mean(text: str, fps: float) -> None:
    assert read_bvh(TINY.replace("0.0333", text)).fps == fps


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (TINY, "\n \n", "empty file"),
        ("0.0333", "-1", "Frame Time: -1"),
        ("0.0333", "nan", "Frame Time: nan"),
        ("0.0333", "soon", "Frame Time: soon"),
        ("Frames: 2", "Frames: 0", "Frames: 0"),
        ("Frames: 2", "Frames: 4", "4 frames, 2 found"),
        ("Frames: 2", "Frames: 2.5", "Frames: "),
        (TINY, TINY + TINY, "a second MOTION section; split"),
        (TINY, TINY + TINY[TINY.index("MOTION") :], "a second MOTION section; split"),
        ("Frames: 2", "Frames: " + "9" * 5000, "Frames: "),
        ("Frames: 2\n", "", "line 21: expected 'Frames"),
        (" -70", " -70x", "frame 1, channel 10 .*'-70x'"),
        (" -70", " 1e999", "frame 1, channel 10 .*'1e999'"),
        (" -70", " nan", "'nan'"),
        (" -70", " 1_0", "'1_0'"),
        (" -70", "\x00", "frame 1"),
        ("HIERARCHY", "", "HIERARCHY"),
        ("OFFSET 1 2 3", "OFFSET 1 2", "line 8: "),
        ("    OFFSET 1 2 3\n", "", "joint 'upper arm' has no OFFSET"),
        ("    CHANNELS 1 Xrotation\n", "", "joint 'upper arm' has no CHANNELS"),
        ("CHANNELS 1 Xrotation", "CHANNELS 1 Wrotation", "unknown channel 'Wrotation'"),
        ("CHANNELS 1 Xrotation", "CHANNELS 2 Xrotation Xrotation", "line 9: "),
        ("CHANNELS 1 Xrotation", "CHANNELS many Xrotation", "line 9: "),
        ("ROOT hips\n{", "ROOT hips\n", "expected '{'"),
        ("MOTION", "}\nMOTION", "'}'"),
        ("MOTION", "ROOT other\n{\n}\nMOTION", "second ROOT"),
        ("JOINT upper arm", "BONE upper arm", "'BONE upper arm'"),
    ],
)
def test_malformed_text_is_refused(old: str, new: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        read_bvh(TINY.replace(old, new, 1), name="tiny")


@pytest.mark.parametrize("name", ["smpl22", "smplx52"])
def test_round_trip(tmp_path: Path, name: str) -> None:
    skeleton, rotations, root = random_motion(name)
    joints, _ = forward_kinematics(rotations, root, skeleton.offsets, skeleton.parents)
    path = tmp_path / "new folder" / "clip.bvh"
    write_bvh(path, skeleton, rotations, root, 20.0)
    motion = read_bvh(path)
    assert motion.fps == 20.0
    order = [motion.joints.index(joint) for joint in skeleton.joints]
    np.testing.assert_allclose(motion.positions()[:, order], joints * 100, atol=1e-3)
    np.testing.assert_allclose(motion.local_rotations(order), rotations.swapaxes(0, 1), atol=1e-6)
    np.testing.assert_allclose(motion.offsets[order][1:], skeleton.offsets[1:] * 100, atol=1e-4)
    np.testing.assert_allclose(bvhio_positions(path), motion.positions(), atol=2e-3)
    assert [p.name for p in path.parent.iterdir()] == ["clip.bvh"]
    # Other tools need an end site at every leaf, and read three rotations a joint.
    leaves = set(range(len(skeleton))) - set(skeleton.parents)
    ends = re.findall(r"End Site\s+{\s+OFFSET (.+)", path.read_text())
    assert len(ends) == len(leaves) and all(
        np.linalg.norm(np.array(end.split(), float)) > 0.5 for end in ends
    )
    assert [len(names) for names in motion.channels] == [6] + [3] * (len(skeleton) - 1)


def test_angles_do_not_jump_between_frames(tmp_path: Path) -> None:
    skeleton = Skeleton.named("smpl22")
    turn = Rotation.from_rotvec(np.arange(0, 800, 10.0)[:, None] * [0, 1, 0], degrees=True).as_matrix()
    rotations = np.tile(np.eye(3), (len(turn), 22, 1, 1))
    rotations[:, 0] = turn
    write_bvh(tmp_path / "spin.bvh", skeleton, rotations, np.zeros((len(turn), 3)), 20.0)
    angles = read_bvh(tmp_path / "spin.bvh").values[:, 3:]
    assert np.abs(np.diff(angles, axis=0)).max() == pytest.approx(10, abs=1e-4)


def test_writer_refuses_wrong_shapes_and_nan_and_leaves_no_file(tmp_path: Path) -> None:
    skeleton, rotations, root = random_motion("smpl22")
    path = tmp_path / "clip.bvh"
    with pytest.raises(UserError, match=r"\[T, 22, 3, 3\]"):
        write_bvh(path, skeleton, rotations[:, :21], root, 20.0)
    with pytest.raises(UserError, match="NaN"):
        write_bvh(path, skeleton, rotations, np.full_like(root, np.nan), 20.0)
    with pytest.raises(UserError, match="fps"):
        write_bvh(path, skeleton, rotations, root, 0.0)
    assert list(tmp_path.iterdir()) == []


def random_motion(name: str, frames: int = 9) -> tuple[Skeleton, np.ndarray, np.ndarray]:
    skeleton = Skeleton.named(name)
    random = np.random.default_rng(7)
    rotations = Rotation.random(frames * len(skeleton), random_state=3).as_matrix()
    rotations[:5] = Rotation.from_euler("ZXY", [30, 90, 20], degrees=True).as_matrix()  # gimbal lock
    return skeleton, rotations.reshape(frames, len(skeleton), 3, 3), random.normal(size=(frames, 3))


def bvhio_positions(path: Path, frames: range | None = None) -> np.ndarray:
    """World positions [T, N, 3] by bvhio, joints in the order of our reader."""
    motion: BvhMotion = read_bvh(path)
    root = bvhio.readAsHierarchy(str(path))
    out = []
    for frame in frames or range(motion.frames):
        root.loadPose(frame)
        world = {joint.Name: tuple(joint.PositionWorld) for joint, _, _ in root.layout()}
        out.append([world[name] for name in motion.joints])
    return np.array(out)


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


def test_a_joint_the_clip_lacks_or_has_twice_is_named(
    tmp_path: Path, shared: Path, bandai: dict[str, Any]
) -> None:
    bandai["smpl22"][0][2] = "hips"
    motion = read_bvh(shared / "data/broken/bvh/control_ok.bvh")
    with pytest.raises(UserError, match=r"control_ok.bvh: no joint 'hips'.*'Hips'"):
        JointMap.load(saved(tmp_path, bandai)).apply(motion)
    text = (shared / "data/broken/bvh/control_ok.bvh").read_text().replace("JOINT Head", "JOINT Neck")
    joint_map = JointMap.load(shared / "data/bandai/joint_map.json")
    with pytest.raises(UserError, match="'Neck' appears 2 times"):
        joint_map.apply(read_bvh(text, name="twice.bvh"))
