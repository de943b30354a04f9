"""Guessed joint maps: the right joint for every one of ours, in the names of many tools or in none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_figures import UNITS, Built, build, write_figure
from foreign_tools import FOREIGN, OTHERS, Foreign

from motionloom.datasets.convert.bvh.joint_guess.guess import JointGuess, guess_joint_map
from motionloom.datasets.motion.bvh.joint_map import JointMap
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
        if not spec.fingers:
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
    collarless = Foreign("x", trunk, ("Neck@neck", "Head@head"), spec.leg, spec.arm[1:])
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
    neckless = Foreign("x", spec.trunk, ("Head@head",), spec.leg, spec.arm)
    assert sources(guess_joint_map(clip(tmp_path, build(neckless)), BODY))["neck"] == (
        "Spine2",
        "Head",
        "Head",
    )
    headless = Foreign("x", spec.trunk, ("bone1@neck", "bone2@a2", "bone3@head"), spec.leg, spec.arm)
    guess = guess_joint_map(clip(tmp_path, build(headless)), BODY)
    assert [row.joint for row in guess.open_rows] == ["neck", "head"] and "bone3" in guess.doubts()
    handless = Foreign("x", spec.trunk, spec.neck, spec.leg, spec.arm[:3])
    guess = guess_joint_map(clip(tmp_path, build(handless)), BODY)
    assert "found no arms" in guess.doubts()
    assert sources(guess)["left_knee"] == ("LeftLeg",), "what is certain is filled in"


@pytest.mark.parametrize("end", [None, "on the ankle", "the heel", "the ball"])
@pytest.mark.parametrize("style", STYLES[:3], ids=str)
def test_feet_without_a_toe_are_end_sites_or_estimated(
    end: str | None, style: dict[str, Any], tmp_path: Path
) -> None:
    spec = BY_TOOL["LAFAN1"]
    built = build(Foreign("x", spec.trunk, spec.neck, spec.leg[:3], spec.arm))
    truth = build(spec)
    style = {key: value for key, value in style.items() if key != "a_pose"}
    world = write_figure(tmp_path / "whole.bvh", truth, frames=40, **style)
    whole = read_bvh(tmp_path / "whole.bvh")
    joints = [whole.joints.index(name) for name in built.names]
    ends = {}
    for side in ("Left", "Right"):
        ankle, toe = whole.joints.index(f"{side}Foot"), whole.joints.index(f"{side}Toe")
        places = {"on the ankle": 0.0, "the heel": -0.5, "the ball": 1.0}
        if end is not None:
            ends[joints.index(ankle)] = places[end] * whole.offsets[toe]
    columns = [c for j in joints for c in range(*(np.cumsum([0, *map(len, whole.channels)])[[j, j + 1]]))]
    motion = BvhMotion(
        "a.bvh", tuple(built.names), tuple(built.parents), whole.offsets[joints],
        tuple(whole.channels[j] for j in joints), whole.values[:, columns], whole.fps, ends,
    )  # fmt: skip
    guess = guess_joint_map(motion, BODY)
    row = {row.joint: row for row in guess.rows}["left_foot"]
    assert guess.certain and row.sources == ("End Site of LeftFoot",)
    assert (row.how, bool(guess.ends)) == (("end", False) if end == "the ball" else ("estimate", True))
    written = tmp_path / "map.json"
    written.write_text(guess.text("skeleton"), encoding="utf-8")
    found = JointMap.load(written).apply(motion, unit=style["unit"], up=style.get("up", "y"))
    wanted = world[:, [truth.names.index(f"{side}Toe") for side in ("Left", "Right")]]
    # The reader's own rounding; or our neutral foot under swinging hips and knees.
    bound = 1e-4 if end == "the ball" else 0.08
    assert np.linalg.norm(found[:, [10, 11]] - wanted, axis=-1).max() < bound


@pytest.mark.parametrize("spec", [*FOREIGN, *OTHERS], ids=lambda spec: spec.tool)
def test_lower_case_and_prefixed_names(spec: Foreign) -> None:
    built = build(spec)
    above = [built.points[max(parent, 0)] for parent in built.parents]
    offsets = np.array(built.points) - np.array(above)
    channels = (("Xposition",), *[()] * (len(offsets) - 1))
    for change in (str.lower, "Actor1_{}".format, "ns|x:{}".format):
        names, rest = tuple(map(change, built.names)), np.zeros((1, 1))
        motion = BvhMotion("a.bvh", names, tuple(built.parents), offsets, channels, rest, 30.0)
        guess = guess_joint_map(motion, BODY)
        assert guess.certain, guess.doubts()
        assert sources(guess) == {joint: tuple(map(change, built.ours[joint])) for joint in BODY.joints}


def test_unknown_toes_and_collars_follow_from_the_tree_and_a_name_of_two_joints_is_said(
    tmp_path: Path,
) -> None:
    change = {
        f"{side}{word}": f"{side}Thing{word[0]}" for side in ("Left", "Right") for word in ("Toe", "Shoulder")
    }
    guess = guess_joint_map(clip(tmp_path, renamed(build(BY_TOOL["LAFAN1"]), change)), BODY)
    rows = {row.joint: row for row in guess.rows}
    assert guess.certain
    assert (rows["left_foot"].sources, rows["left_foot"].how) == (("LeftThingT",), "hierarchy")
    assert (rows["right_collar"].sources, rows["right_collar"].how) == (("RightThingS",), "hierarchy")
    guess = guess_joint_map(clip(tmp_path, renamed(build(BY_TOOL["LAFAN1"]), {"Spine1": "Spine"})), BODY)
    assert not guess.certain and "Spine: two joints" in guess.doubts()
