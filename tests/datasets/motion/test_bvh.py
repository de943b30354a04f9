"""BVH reader and writer: broken inputs, any channel order, and an independent library as the oracle."""

from __future__ import annotations

import tarfile
from pathlib import Path

import bvhio
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.bvh.motion import BvhMotion, read_bvh, read_header, write_bvh
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError

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


def test_bom_and_crlf_equal_the_control(shared: Path) -> None:
    folder = shared / "data/broken/bvh"
    control, other = read_bvh(folder / "control_ok.bvh"), read_bvh(folder / "crlf_bom.bvh")
    assert (control.fps, control.frames, len(control.joints)) == (30.0, 6, 22)
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
    assert read_header(path).frames == motion.frames == 128
    np.testing.assert_allclose(motion.positions()[::16], bvhio_positions(path, range(0, 128, 16)), atol=2e-3)


def test_any_channels_in_any_order() -> None:
    motion = read_bvh(TINY)
    assert motion.joints == ("hips", "upper arm", "hand")
    assert motion.parents == (-1, 0, 1)
    assert motion.fps == 30.0
    assert motion.end_sites == ((2, (0.0, 0.0, 1.0)),)
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
    assert read_header(TINY.replace("0.0333", text)).fps == fps


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0.0333", "-1", "Frame Time: -1"),
        ("0.0333", "nan", "Frame Time: nan"),
        ("0.0333", "soon", "'Frame Time: soon' is not a number"),
        ("Frames: 2", "Frames: 0", "no frames"),
        ("Frames: 2", "Frames: 2.5", "not a whole number"),
        ("Frames: 2", "Frames: " + "9" * 5000, "not a whole number"),
        ("Frames: 2\n", "", "line 21: expected 'Frames"),
        (" -70", " -70x", "frame 1, channel 10 .*'-70x'"),
        (" -70", " 1e999", "frame 1, channel 10 .*'1e999'"),
        (" -70", " nan", "'nan' is not a finite number"),
        (" -70", " 1_0", "'1_0' is not a finite number"),
        (" -70", "\x00", "frame 1"),
        ("HIERARCHY", "", "must start with HIERARCHY"),
        ("OFFSET 1 2 3", "OFFSET 1 2", "line 8: .*three finite numbers"),
        ("    OFFSET 1 2 3\n", "", "joint 'upper arm' has no OFFSET"),
        ("    CHANNELS 1 Xrotation\n", "", "joint 'upper arm' has no CHANNELS"),
        ("CHANNELS 1 Xrotation", "CHANNELS 1 Wrotation", "unknown channel 'Wrotation'"),
        ("CHANNELS 1 Xrotation", "CHANNELS 2 Xrotation Xrotation", "lists a channel twice"),
        ("CHANNELS 1 Xrotation", "CHANNELS many Xrotation", "count from 0 to 6"),
        ("ROOT hips\n{", "ROOT hips\n", "expected '{'"),
        ("MOTION", "}\nMOTION", "'}' is not expected"),
        ("MOTION", "ROOT other\n{\n}\nMOTION", "second ROOT"),
        ("JOINT upper arm", "BONE upper arm", "'BONE upper arm' is not expected"),
    ],
)
def test_malformed_text_is_refused(old: str, new: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        read_bvh(TINY.replace(old, new, 1), name="tiny")


def test_missing_and_empty_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot read"):
        read_bvh(tmp_path / "none.bvh")
    with pytest.raises(UserError, match="cannot read"):
        read_bvh(tmp_path)
    (tmp_path / "empty.bvh").touch()
    with pytest.raises(UserError, match="empty file"):
        read_bvh(str(tmp_path / "empty.bvh"))
    with pytest.raises(UserError, match="no joint has a channel"):
        read_bvh(b"HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 0\n}\nMOTION\nFrames: 1\nFrame Time: 1\n0\n")


def test_truncation_anywhere_is_an_error_or_a_smaller_valid_file() -> None:
    data = TINY.encode()
    end = len(data.rstrip()) - 1  # losing only digits of the last number cannot be seen
    for cut in range(0, end - 2, 7):
        with pytest.raises(UserError):
            read_bvh(data[:cut] or b" ")


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
    assert {joint for joint, _ in motion.end_sites} == set(range(len(skeleton))) - set(motion.parents)
    assert all(np.linalg.norm(offset) > 0.5 for _, offset in motion.end_sites)
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
    with pytest.raises(UserError, match=r"rotations \[T, 22, 3, 3\]"):
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
