"""Guessed joint maps: the right joint for every one of ours, in the names of many tools or in none."""

from __future__ import annotations

import json
import re
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_figures import UNITS, Built, build, write_figure
from foreign_tools import FOREIGN, OTHERS, Foreign

from motionloom.datasets.motion.bvh import BvhMotion, read_bvh
from motionloom.datasets.motion.joint_guess.guess import guess_joint_map
from motionloom.datasets.motion.joint_guess.names import read_names
from motionloom.datasets.motion.joint_guess.result import JointGuess
from motionloom.datasets.motion.joint_map import JointMap
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError

BODY, WHOLE = Skeleton.named("smpl22"), Skeleton.named("smplx52")
BY_TOOL = {spec.tool: spec for spec in FOREIGN}
STYLES: tuple[dict[str, Any], ...] = (
    {"unit": "cm", "fps": 120.0},
    {"unit": "m", "up": "z", "a_pose": True},
    {"unit": "mm", "twisted": True},
    {"unit": "inch", "up": "z", "twisted": True, "a_pose": True},
)
"""Every unit, both axes, both poses, and rest poses that are none."""


def clip(folder: Path, built: Built, name: str = "clip.bvh", **style: Any) -> BvhMotion:
    write_figure(folder / name, built, frames=40, **style)
    return read_bvh(folder / name)


def sources(guess: JointGuess) -> dict[str, tuple[str, ...]]:
    return {row.joint: row.sources for row in guess.rows}


@pytest.mark.parametrize("spec", FOREIGN, ids=lambda spec: spec.tool)
def test_every_joint_of_every_tool(spec: Foreign, tmp_path: Path) -> None:
    assert {style["unit"] for style in STYLES} == set(UNITS)
    for number, style in enumerate(STYLES):
        built = build(spec, a_pose=style.get("a_pose", False))
        motion = clip(tmp_path, built, **{k: v for k, v in style.items() if k != "a_pose"}, seed=number)
        guess = guess_joint_map(motion, BODY)
        assert guess.certain, guess.doubts()
        assert sources(guess) == {joint: built.ours[joint] for joint in BODY.joints}
        assert set(guess.unmapped) == set(built.names) - {s for row in guess.rows for s in row.sources}
        whole = guess_joint_map(motion, WHOLE)
        if spec.fingers is None:
            assert not whole.certain and "left_index1" in whole.doubts()
            assert {row.joint for row in whole.open_rows} == set(WHOLE.joints) - set(BODY.joints)
        else:
            assert whole.certain, whole.doubts()
            assert sources(whole) == {joint: built.ours[joint] for joint in WHOLE.joints}


@pytest.mark.parametrize("spec", FOREIGN, ids=lambda spec: spec.tool)
def test_the_map_gives_the_joints_of_the_figure(spec: Foreign, tmp_path: Path) -> None:
    built = build(spec)
    world = write_figure(tmp_path / "clip.bvh", built, unit="mm", up="z", twisted=True, frames=20)
    guess = guess_joint_map(read_bvh(tmp_path / "clip.bvh"), BODY)
    joints = guess.joint_map("guess").apply(read_bvh(tmp_path / "clip.bvh"), unit="mm", up="z")
    index = {name: i for i, name in enumerate(built.names)}
    true = [world[:, [index[n] for n in built.ours[joint]]].mean(axis=1) for joint in BODY.joints]
    # Angles and offsets are written to 1e-6 degrees and mm: some 1e-8 rad along two metres of bones.
    np.testing.assert_allclose(joints, np.stack(true, axis=1), atol=1e-6)


@pytest.mark.parametrize("spec", OTHERS, ids=lambda spec: spec.tool)
def test_the_other_tools_of_the_table(spec: Foreign, tmp_path: Path) -> None:
    built = build(spec)
    target = WHOLE if spec.fingers else BODY
    guess = guess_joint_map(clip(tmp_path, built, unit="m", up="z", twisted=True), target)
    assert guess.certain, guess.doubts()
    assert sources(guess) == {joint: built.ours[joint] for joint in target.joints}


def without_names(spec: Foreign) -> Built:
    built = build(spec)
    shuffled = np.random.default_rng(3).permutation(len(built.names))
    new = {old: f"q{number}x" for old, number in zip(built.names, shuffled, strict=True)}
    built.names = [new[name] for name in built.names]
    built.ours = {joint: tuple(new[name] for name in names) for joint, names in built.ours.items()}
    return built


def test_names_that_say_nothing(tmp_path: Path) -> None:
    """Certain where the tree allows nothing else; elsewhere open, and what is filled in is right."""
    certain = set()
    for spec in FOREIGN:
        built = without_names(spec)
        guess = guess_joint_map(clip(tmp_path, built, unit="m", up="z", twisted=True), BODY)
        wrong = {j: s for j, s in sources(guess).items() if s and s != built.ours[j]}
        assert not wrong, spec.tool
        if guess.certain:
            certain.add(spec.tool)
        else:
            assert guess.doubts()
    # The others have three joints above the arms, two in an upper leg, or collars as long as arms.
    assert certain == {"LAFAN1", "Rokoko", "Xsens MVN", "SMPL", "Bandai-Namco"}


def test_real_clips_under_other_names(shared: Path) -> None:
    mine = JointMap.load(shared / "data/bandai/joint_map.json")
    mixamo = ("Hips", "UpLeg", "Leg", "Foot", "ToeBase", "Shoulder", "Arm", "ForeArm", "Hand")
    theirs = ("Hips", "UpperLeg", "LowerLeg", "Foot", "Toes", "Shoulder", "UpperArm", "LowerArm", "Hand")
    words = dict(zip(theirs, mixamo, strict=True)) | {"Chest": "Spine1"}
    with tarfile.open(shared / "data/bandai/dataset-1.tar.xz", "r|*") as archive:
        texts = []
        for member in archive:
            file = archive.extractfile(member) if member.name.endswith(".bvh") else None
            if file is not None:
                texts.append(file.read().decode())
            if len(texts) == 3:
                break

    def mixamo_name(name: str) -> str:
        word, _, side = name.partition("_")
        return f"mixamorig:{ {'L': 'Left', 'R': 'Right'}.get(side, '') }{words.get(word, word)}"

    def nonsense(name: str) -> str:
        return f"bone {sum(map(ord, name)) * 7919 % 100_003}"

    for text in texts:
        names = re.findall(r"(?:ROOT|JOINT)\s+(\S+)", text)
        for rename in (str, mixamo_name, nonsense):
            old = {rename(name): name for name in names}
            assert len(old) == len(names)
            renamed = re.sub(r"(ROOT|JOINT)(\s+)(\S+)", lambda m: m[1] + m[2] + rename(m[3]), text)  # noqa: B023
            guess = guess_joint_map(read_bvh(renamed, name="clip.bvh"), BODY)
            assert guess.certain, guess.doubts()
            rows = tuple(tuple(old[name] for name in row.sources) for row in guess.rows)
            assert rows == mine.sources
            how = {row.how for row in guess.rows}
            assert how == ({"hierarchy", "mean"} if rename is nonsense else {"name", "mean"})


def renamed(built: Built, change: dict[str, str]) -> Built:
    built.names = [change.get(name, name) for name in built.names]
    return built


@pytest.mark.parametrize("twisted", [False, True])
def test_swapped_sides_are_not_taken(tmp_path: Path, twisted: bool) -> None:
    for tool in ("LAFAN1", "SMPL-X"):
        left, right = BY_TOOL[tool].sides
        for limbs, said in (
            (("leg", "arm"), "the left leg.*the left arm"),
            (("arm",), "left arm"),
            (("leg",), "left leg"),
        ):
            built = build(BY_TOOL[tool])
            chosen = [j.split("@")[0] for limb in limbs for j in getattr(BY_TOOL[tool], limb)]
            pairs = [(j.format(left), j.format(right)) for j in chosen]
            swap = {a: b for pair in pairs for a, b in (pair, pair[::-1])}
            guess = guess_joint_map(clip(tmp_path, renamed(built, swap), twisted=twisted), BODY)
            assert not guess.certain
            assert re.search(said, guess.doubts())
            note = json.loads(guess.text())["note"]
            assert "NOT CERTAIN" in note and note.endswith("Correct the rows")


def test_a_single_name_on_the_wrong_joint(tmp_path: Path) -> None:
    """The left foot's name on the right one: no chain has all words, and the branches' names disagree."""
    built = renamed(build(BY_TOOL["LAFAN1"]), {"LeftFoot": "RightFoot", "RightFoot": "LeftFoot"})
    guess = guess_joint_map(clip(tmp_path, built), BODY)
    ankles = {row.joint: row.sources for row in guess.rows if row.joint.endswith("ankle")}
    assert not guess.certain and "'RightFoot' would be left_ankle" in guess.doubts()
    assert ankles == {"left_ankle": ("RightFoot",), "right_ankle": ("LeftFoot",)}


def test_missing_joints_are_means_or_open(tmp_path: Path) -> None:
    spec = BY_TOOL["LAFAN1"]
    trunk = ("Hips@pelvis", "Spine@spine3")
    collarless = Foreign("x", (), trunk, ("Neck@neck", "Head@head"), spec.leg, spec.arm[1:])
    guess = guess_joint_map(clip(tmp_path, build(collarless)), BODY)
    rows = sources(guess)
    assert guess.certain
    assert rows["left_collar"] == ("Spine", "Neck", "LeftArm")
    assert (rows["spine1"], rows["spine2"]) == (("Hips", "Hips", "Spine"), ("Hips", "Spine", "Spine"))
    # The mean is where our collar is, to a few centimetres.
    motion = read_bvh(tmp_path / "clip.bvh")
    joints = guess.joint_map("guess").apply(motion)
    bone = np.linalg.norm(joints[:, BODY.index("left_collar")] - joints[:, BODY.index("spine3")], axis=-1)
    assert np.abs(bone - np.linalg.norm(BODY.offsets[BODY.index("left_collar")])).max() < 0.03
    neckless = Foreign("x", (), spec.trunk, ("Head@head",), spec.leg, spec.arm)
    assert sources(guess_joint_map(clip(tmp_path, build(neckless)), BODY))["neck"] == (
        "Spine2",
        "Head",
        "Head",
    )
    toeless = Foreign("x", (), spec.trunk, spec.neck, spec.leg[:3], spec.arm)
    guess = guess_joint_map(clip(tmp_path, build(toeless)), BODY)
    assert [row.joint for row in guess.open_rows] == ["left_foot", "right_foot"]
    headless = Foreign("x", (), spec.trunk, ("bone1@neck", "bone2@a2", "bone3@head"), spec.leg, spec.arm)
    guess = guess_joint_map(clip(tmp_path, build(headless)), BODY)
    assert "neck (bone1 or bone2 or bone3?), head (bone1 or bone2 or bone3?)" in guess.doubts()
    handless = Foreign("x", (), spec.trunk, spec.neck, spec.leg, spec.arm[:3])
    guess = guess_joint_map(clip(tmp_path, build(handless)), BODY)
    assert "found no arms" in guess.doubts()
    assert sources(guess)["left_knee"] == ("LeftLeg",), "what is certain is filled in"


def test_unknown_toes_and_collars_follow_from_the_tree(tmp_path: Path) -> None:
    change = {
        f"{side}{word}": f"{side}Thing{word[0]}" for side in ("Left", "Right") for word in ("Toe", "Shoulder")
    }
    guess = guess_joint_map(clip(tmp_path, renamed(build(BY_TOOL["LAFAN1"]), change)), BODY)
    rows = {row.joint: row for row in guess.rows}
    assert guess.certain
    assert (rows["left_foot"].sources, rows["left_foot"].how) == (("LeftThingT",), "hierarchy")
    assert (rows["right_collar"].sources, rows["right_collar"].how) == (("RightThingS",), "hierarchy")


def test_one_name_for_two_joints_is_said(tmp_path: Path) -> None:
    guess = guess_joint_map(clip(tmp_path, renamed(build(BY_TOOL["LAFAN1"]), {"Spine1": "Spine"})), BODY)
    assert not guess.certain and "Spine: two joints of one name" in guess.doubts()


def test_bones_that_no_person_has_are_said(tmp_path: Path) -> None:
    built = build(BY_TOOL["LAFAN1"])
    knee, hip = (built.names.index(name) for name in ("LeftLeg", "LeftUpLeg"))
    built.points[knee] = built.points[hip] + 0.2 * (built.points[knee] - built.points[hip])
    guess = guess_joint_map(clip(tmp_path, built), BODY)
    assert "different lengths" in guess.doubts() and "2.5 times the other" in guess.doubts()


def test_the_written_map_is_read_again_and_can_be_completed(tmp_path: Path) -> None:
    spec = BY_TOOL["LAFAN1"]
    guess = guess_joint_map(clip(tmp_path, build(spec)), BODY)
    path = tmp_path / "map.json"
    path.write_text(guess.text())
    again = JointMap.load(path)
    assert again.sources == guess.joint_map("guess").sources and again.unmapped == guess.unmapped
    toeless = Foreign("x", (), spec.trunk, spec.neck, (*spec.leg[:3], "{}A@foot"), spec.arm)
    built = build(toeless)
    for side in ("left", "right"):
        ankle = built.names.index(f"{side.title()}Foot")
        built.add(f"{side}_heel", ankle, built.points[ankle] + [0, -0.06, -0.05])
    guess = guess_joint_map(clip(tmp_path, built), BODY)
    path.write_text(guess.text())
    data = json.loads(path.read_text())
    assert data["candidates"]["left_foot"] == ["LeftA", "left_heel"]
    assert "left_foot (LeftA or left_heel?)" in data["note"] and "rows that say null" in data["note"]
    assert data["smpl22"][10] == [10, "left_foot", None]
    with pytest.raises(
        UserError, match=r"map.json: smpl22 rows still to be filled in \(null\): left_foot, right_foot"
    ):
        JointMap.load(path)
    with pytest.raises(ValueError, match="not certain"):
        guess.joint_map("guess")
    data["smpl22"][10][2], data["smpl22"][11][2] = "LeftA", "RightA"
    path.write_text(json.dumps(data))
    assert JointMap.load(path).sources[10:12] == (("LeftA",), ("RightA",))


def test_names_are_read_without_prefix_and_side() -> None:
    cases = {
        ("mixamorig:LeftUpLeg", "mixamorig:Hips", "mixamorig:HeadTop_End"): [
            ("left", "upleg", False),
            ("", "hips", False),
            ("", "headtopend", True),
        ],
        ("Bip01 L UpperArm", "Bip01 Pelvis", "Bip01 R Calf", "Bip01"): [
            ("left", "upperarm", False),
            ("", "pelvis", False),
            ("right", "calf", False),
            ("", "1", False),
        ],
        ("lfemur", "rradius", "lowerback"): [
            ("left", "femur", False),
            ("right", "radius", False),
            ("", "lowerback", False),
        ],
        ("LHipJoint", "upperarm_twist_01_l", "KneeLeft"): [
            ("left", "hipjoint", False),
            ("left", "upperarmtwist1", True),
            ("left", "knee", False),
        ],
        ("左足", "右足", "首"): [("", "左足", False), ("", "右足", False), ("", "首", False)],
    }
    for names, expected in cases.items():
        assert [(n.side, n.word, n.spare) for n in read_names(names)] == expected
