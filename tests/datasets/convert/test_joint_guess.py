"""Guessed joint maps: the right joint for every one of ours, in the names of many tools or in none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_figures import UNITS, Built, build, write_figure
from foreign_tools import FOREIGN, OTHERS, Foreign

from motionloom.datasets.convert.bvh.joint_guess.guess import JointGuess, guess_joint_map
from motionloom.datasets.motion.bvh.motion import BvhMotion, read_bvh
from motionloom.datasets.motion.skeleton import Skeleton

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


@pytest.mark.parametrize("spec", OTHERS, ids=lambda spec: spec.tool)
def test_the_other_tools_of_the_table(spec: Foreign, tmp_path: Path) -> None:
    built = build(spec)
    target = WHOLE if spec.fingers else BODY
    guess = guess_joint_map(clip(tmp_path, built, unit="m", up="z", twisted=True), target)
    assert guess.certain, guess.doubts()
    assert sources(guess) == {joint: built.ours[joint] for joint in target.joints}


def renamed(built: Built, change: dict[str, str]) -> Built:
    built.names = [change.get(name, name) for name in built.names]
    return built


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
