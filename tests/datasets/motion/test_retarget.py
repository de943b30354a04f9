"""Rotations of files on our skeleton: heads, palms, feet and hips against kinematics of the test's own."""

from __future__ import annotations

import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_figures import build, bvh_text
from foreign_tools import FOREIGN
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.convert.bvh.joint_guess import guess_joint_map
from motionloom.datasets.convert.bvh.read import read_file, read_motion
from motionloom.datasets.convert.bvh.settle import settled
from motionloom.datasets.motion.body.retarget import carried, on_bones, with_hands
from motionloom.datasets.motion.body.rigid import RigidMotion, fit_rigid
from motionloom.datasets.motion.bvh.motion import BvhMotion
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.skeleton import Skeleton

Floats = NDArray[np.float64]
BODY = Skeleton.named("smpl22")
PARTS = {"head": 2, "left_wrist": 1, "right_wrist": 1, "left_foot": 2, "pelvis": 2}
"""Joints that are looked at, and an axis of each in our rest pose: ahead, or up from the back of a hand."""
GENUINE = {
    "bandai/dataset-1.tar.xz": ("dataset-1_walk_feminine_001.bvh", "dataset-1_byebye_active_001.bvh"),
    "real/cmu/bvh_mb.tar.xz": ("02_01.bvh", "05_11.bvh"),
    "real/cmu/amc.tar.xz": ("02_01.amc",),
    "real/hdm05/hdm05.tar.xz": ("HDM_bd_depositFloorR_001_120.amc", "HDM_mm_lieDownFloor_016_120.amc"),
    "real/odd_bvh": (
        "sfu_affective_vicon.bvh",
        "freebvh.bvh",
        "virvig_dancedb_metres.bvh",
        "momask_template.bvh",
    ),
}


def world(motion: BvhMotion) -> Floats:
    """World rotations [T, N, 3, 3] by the channels of the file, one after the other."""
    turns: list[Rotation] = []
    column = 0
    for parent, names in zip(motion.parents, motion.channels, strict=True):
        turns.append(Rotation.identity(motion.frames) if parent < 0 else turns[parent])
        for name in names:
            if name.endswith("rotation"):
                turns[-1] = turns[-1] * Rotation.from_euler(name[0], motion.values[:, [column]], degrees=True)
            column += 1
    return np.stack([turn.as_matrix() for turn in turns], axis=1)


def taken(motion: BvhMotion) -> tuple[RigidMotion, dict[str, Floats], str]:
    """The figure of a file, and world rotations of the joints that stand for `PARTS`; which axis is up."""
    joint_map = guess_joint_map(motion, BODY)
    unit, up, _ = settled(joint_map, [motion])
    turns = world(motion)
    seen = {name: turns[:, motion.joints.index(joint_map.sources[BODY.index(name)][0])] for name in PARTS}
    return carried(joint_map.figure(motion, unit=unit, up=up), BODY), seen, up


def shown(figure: RigidMotion) -> dict[str, Floats]:
    """Where the parts look [T, 3]."""
    skeleton = figure.skeleton
    turns = forward_kinematics(figure.rotations, figure.root, skeleton.offsets, skeleton.parents)[1]
    return {name: turns[:, skeleton.index(name), :, axis] for name, axis in PARTS.items()}


def require_near(figure: RigidMotion, wanted: dict[str, Floats]) -> None:
    for name, way in shown(figure).items():
        apart = np.degrees(np.arccos(np.clip((way * wanted[name]).sum(axis=-1), -1, 1)))
        assert np.median(apart) < 5 and np.percentile(apart, 95) < 10, (name, np.median(apart), apart.max())


@pytest.mark.parametrize("folder", GENUINE)
def test_parts_look_where_the_file_says(shared: Path, tmp_path: Path, folder: str) -> None:
    place = shared / "data" / folder
    if place.is_file():
        with tarfile.open(place) as tar:
            subjects = [one[:6] if one.startswith("HDM") else one.split("_0")[0] for one in GENUINE[folder]]
            for member in tar.getmembers():
                name = Path(member.name).name
                if name in GENUINE[folder] or (name.endswith(".asf") and name[:-4] in subjects):
                    member.name = name
                    tar.extract(member, tmp_path, filter="data")
        place = tmp_path
    upright = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    for name in GENUINE[folder]:
        motion = read_motion(read_file(place / name, name), name)
        figure, turns, up = taken(replace(motion, values=motion.values[:: 1 + motion.frames // 400]))
        # Axes of the file that point there: bones of Bandai's lie along x, right ones turned round.
        named = {part: np.eye(3)[axis] for part, axis in PARTS.items()}
        if "bandai" in folder:
            named |= {"head": [0, 1, 0], "right_wrist": [0, -1, 0], "left_foot": [1, 0, 0]}
        if up == "z":
            named = {part: upright.T @ axis for part, axis in named.items()}
        wanted = {part: turns[part] @ axis for part, axis in named.items()}
        if up == "z":
            wanted = {part: way @ upright.T for part, way in wanted.items()}
        require_near(figure, wanted)
        # On other bones, with hands, they look there as well; and positions alone leave a head level.
        whole = with_hands(figure)
        require_near(on_bones(whole, Skeleton.named("smplx52").offsets), wanted)
        assert figure.error.mean_mm < (8 if "lieDown" in name else 4)
        if "walk" in name or name == "02_01.bvh":
            level = shown(fit_rigid(figure.joints, BODY))["head"]
            assert abs(np.degrees(np.arcsin(np.median(level[:, 1])))) < 6


@pytest.mark.parametrize("tool", ["Mixamo", "CMU", "LAFAN1", "Rokoko", "SMPL-X", "Unreal mannequin"])
@pytest.mark.parametrize("a_pose", [False, True])
@pytest.mark.parametrize("along", [False, True])
def test_built_figures_look_where_they_were_turned(tool: str, a_pose: bool, along: bool) -> None:
    """`along`: all rest axes along the bones, so that the rest pose is a line, as LAFAN1's is."""
    built = build(next(one for one in FOREIGN if one.tool == tool), a_pose=a_pose)
    ours = {names[0]: joint for joint, names in built.ours.items() if len(names) == 1}
    place = [ours.get(name, "") for name in built.names]
    leaning = [place.index("neck")]  # where arms hang, heads lean forward and look ahead all the same
    for joint, parent in enumerate(built.parents if a_pose and not along else ()):
        if parent in leaning:
            leaning.append(joint)
            up = built.points[joint] - built.points[leaning[0]]
            built.points[joint] += Rotation.from_euler("x", 40, degrees=True).apply(up) - up
    rng = np.random.default_rng(3)
    count, times = len(built.names), np.arange(80)[:, None, None] / 30
    swing = 0.15 * np.sin(times * rng.uniform(1, 4, (count, 1))) * rng.standard_normal((count, 3))
    for number, name in enumerate(place):  # elbows bend one way
        if name.endswith("elbow"):
            swing[:, number] += [0, -0.6 if name.startswith("left") else 0.6, 0]
    local = Rotation.from_rotvec(swing.reshape(-1, 3)).as_matrix().reshape(80, count, 3, 3)
    axes = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
    for joint in range(count if along else 0):
        ends = [child for child, parent in enumerate(built.parents) if parent == joint and place[child]]
        alone = len(ends) == 1 and place[joint] != "head"
        bone = built.points[ends[0]] - built.points[joint] if alone else np.array([0.0, 1.0, 0.0])
        if place[joint].endswith("wrist"):
            bone = built.points[joint] - built.points[built.parents[joint]]
        if "_foot" in place[joint]:
            bone = np.array([0.0, 0.0, 1.0])
        side = (
            np.array([0.0, 0.0, 1.0])
            if abs(bone[2]) < 0.5 * np.linalg.norm(bone)
            else np.array([0.0, 1.0, 0.0])
        )
        x = bone / np.linalg.norm(bone)
        y = np.cross(side, x) / np.linalg.norm(np.cross(side, x))
        axes[joint] = np.stack([x, y, np.cross(x, y)], axis=1)
    root = np.tile([0.0, 0.95, 0.0], (80, 1)) + built.points[0]
    motion = read_motion(bvh_text(built, local, root, axes, fps=30)[0].encode(), tool)
    figure, turns, _ = taken(motion)
    number = {name: built.names.index(built.ours[name][0]) for name in PARTS}
    wanted = {name: (turns[name] @ axes[number[name]].T)[:, :, axis] for name, axis in PARTS.items()}
    if a_pose:  # a hanging arm's palm is turned with it
        for side, sign in (("left", -1), ("right", 1)):
            hang = Rotation.from_euler("z", sign * 45, degrees=True).as_matrix()
            name = f"{side}_wrist"
            wanted[name] = turns[name] @ axes[number[name]].T @ hang[:, 1]
    require_near(figure, wanted)
