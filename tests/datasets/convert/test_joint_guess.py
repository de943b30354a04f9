"""Guessed joint maps: the right joint for every one of ours, in the names of many tools."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_figures import UNITS, Built, build, write_figure
from foreign_tools import FOREIGN, OTHERS, Foreign

from motionloom.datasets.convert.bvh.joint_guess import guess_joint_map
from motionloom.datasets.convert.bvh.tools import CONVENTIONS
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


def sources(guess: JointMap) -> dict[str, tuple[str, ...]]:
    return dict(zip(guess.target.joints, guess.sources, strict=True))


@pytest.mark.parametrize("spec", [*FOREIGN, *OTHERS], ids=lambda spec: spec.tool)
def test_every_joint_of_every_tool(spec: Foreign, tmp_path: Path) -> None:
    assert {style["unit"] for style in STYLES} == set(UNITS)
    for number, style in enumerate(STYLES if spec in FOREIGN else STYLES[2:3]):
        built = build(spec, a_pose=style.get("a_pose", False))
        motion = clip(tmp_path, built, **{k: v for k, v in style.items() if k != "a_pose"}, seed=number)
        guess = guess_joint_map(motion, BODY)
        assert sources(guess) == {joint: built.ours[joint] for joint in BODY.joints}
        assert set(guess.unmapped) == set(built.names) - {name for names in guess.sources for name in names}
        whole = guess_joint_map(motion, WHOLE)
        if not spec.fingers:
            assert set(whole.open_rows) == set(WHOLE.joints) - set(BODY.joints)
        else:
            assert sources(whole) == {joint: built.ours[joint] for joint in WHOLE.joints}


def test_missing_joints_are_means_or_open(tmp_path: Path) -> None:
    spec = BY_TOOL["LAFAN1"]
    trunk = ("Hips@pelvis", "Spine@spine3")
    collarless = Foreign("x", trunk, ("Neck@neck", "Head@head"), spec.leg, spec.arm[1:])
    guess = guess_joint_map(clip(tmp_path, build(collarless)), BODY)
    rows = sources(guess)
    assert not guess.open_rows
    assert rows["left_collar"] == ("Spine", "Neck", "LeftArm")
    assert (rows["spine1"], rows["spine2"]) == (("Hips", "Hips", "Spine"), ("Hips", "Spine", "Spine"))
    # The mean is where our collar is, to a few centimetres.
    joints = guess.apply(read_bvh(tmp_path / "clip.bvh"))
    bone = np.linalg.norm(joints[:, BODY.index("left_collar")] - joints[:, BODY.index("spine3")], axis=-1)
    assert np.abs(bone - np.linalg.norm(BODY.offsets[BODY.index("left_collar")])).max() < 0.03

    def rows_of(*chains: tuple[str, ...], change: dict[str, str] | None = None) -> dict[str, tuple[str, ...]]:
        built = build(Foreign("x", spec.trunk, *chains))
        built.names = [(change or {}).get(name, name) for name in built.names]
        return sources(guess_joint_map(clip(tmp_path, built), BODY))

    def open_rows(rows: dict[str, tuple[str, ...]]) -> list[str]:
        return [joint for joint, names in rows.items() if not names]

    whole = (spec.neck, spec.leg, spec.arm)
    assert rows_of(("Head@head",), *whole[1:])["neck"] == ("Spine2", "Head", "Head")
    assert open_rows(rows_of(("bone1@neck", "bone2@a2", "bone3@head"), *whole[1:])) == ["neck", "head"]
    handless = rows_of(*whole[:2], spec.arm[:3])
    assert handless["left_knee"] == ("LeftLeg",), "what is certain is filled in"
    assert "pelvis" in open_rows(handless) and "left_shoulder" in open_rows(handless)
    assert open_rows(rows_of(*whole, change={"Spine1": "Spine"})) == ["spine1", "spine2"]


@pytest.mark.parametrize("end", [None, "on the ankle", "the heel", "the ball", "a toe on it"])
@pytest.mark.parametrize("style", STYLES[:3], ids=str)
def test_feet_without_a_toe_are_end_sites_or_estimated(
    end: str | None, style: dict[str, Any], tmp_path: Path
) -> None:
    spec = BY_TOOL["LAFAN1"]
    truth = build(spec)
    toed = end == "a toe on it"
    built = truth if toed else build(Foreign("x", spec.trunk, spec.neck, spec.leg[:3], spec.arm))
    style = {key: value for key, value in style.items() if key != "a_pose"}
    world = write_figure(tmp_path / "whole.bvh", truth, frames=40, **style)
    whole = read_bvh(tmp_path / "whole.bvh")
    joints = [whole.joints.index(name) for name in built.names]
    ends = {}
    for side in ("Left", "Right"):
        ankle, toe = whole.joints.index(f"{side}Foot"), whole.joints.index(f"{side}Toe")
        places = {"on the ankle": 0.0, "the heel": -0.5, "the ball": 1.0}
        if toed:
            whole.offsets[toe] = 0.0
        elif end is not None:
            ends[joints.index(ankle)] = places[end] * whole.offsets[toe]
    columns = [c for j in joints for c in range(*(np.cumsum([0, *map(len, whole.channels)])[[j, j + 1]]))]
    motion = BvhMotion(
        "a.bvh", tuple(built.names), tuple(built.parents), whole.offsets[joints],
        tuple(whole.channels[j] for j in joints), whole.values[:, columns], whole.fps, ends,
    )  # fmt: skip
    guess = guess_joint_map(motion, BODY)
    assert not guess.open_rows and sources(guess)["left_foot"] == ("End Site of LeftFoot",)
    assert bool(guess.ends) is (end != "the ball")
    written = tmp_path / "map.json"
    written.write_text(guess.text("guessed"), encoding="utf-8")
    found = JointMap.load(written).apply(motion, unit=style["unit"], up=style.get("up", "y"))
    wanted = world[:, [truth.names.index(f"{side}Toe") for side in ("Left", "Right")]]
    # The reader's own rounding; or our neutral foot under swinging hips and knees.
    bound = 1e-4 if end == "the ball" else 0.08
    assert np.linalg.norm(found[:, [10, 11]] - wanted, axis=-1).max() < bound


def verdict(built: Built, change: Callable[[str], str]) -> tuple[str, ...]:
    """The open rows of a figure at rest with changed names, once no row is found wrong."""
    above = [built.points[max(parent, 0)] for parent in built.parents]
    offsets = np.array(built.points) - np.array(above)
    channels = (("Xposition",), *[()] * (len(offsets) - 1))
    names = tuple(map(change, built.names))
    motion = BvhMotion("a.bvh", names, tuple(built.parents), offsets, channels, np.zeros((1, 1)), 30.0)
    guess = guess_joint_map(motion, BODY)
    for joint, found in sources(guess).items():
        assert found in ((), tuple(map(change, built.ours[joint]))), joint
    return guess.open_rows


@pytest.mark.parametrize("spec", [*FOREIGN, *OTHERS], ids=lambda spec: spec.tool)
def test_other_names_are_read_by_the_tree_or_refused(spec: Foreign) -> None:
    """In small letters and with prefixes all is found; strange names of both sides where the tree tells."""
    built = build(spec)
    for change in (str.lower, "Actor1_{}".format, "ns|x:{}".format):
        assert not verdict(built, change)
    helped = {"CMU", "Rigify", "Unreal mannequin", "DAZ Genesis 8", "MakeHuman (default rig)"}
    faces = {"SMPL-X", "BONES, SOMA 77", "Unity, VRM", "DAZ, Poser", "MakeHuman (CMU rig)", *helped} - {"CMU"}
    for places in ((f"left_{one}", f"right_{one}") for one in LIMBS):
        names = {built.ours[place][0]: f"{side}_Odd" for place, side in zip(places, spec.sides, strict=True)}
        if len(built.ours[places[0]]) == 1 and (spec.tool, places[0]) != ("CMU", "left_collar"):
            assert not verdict(built, lambda name, names=names: names.get(name, name)) or spec.tool in helped
    if spec.tool != "CMU (ASF)":  # its upper neck is Dance-DB's head
        assert not verdict(built, lambda name: "Odd" if name in built.ours["head"] else name) or (
            spec.tool in faces
        )


LIMBS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")


@pytest.mark.parametrize("seed", range(4))
def test_limbs_with_words_of_several_tools(seed: int) -> None:
    rng = np.random.default_rng(seed)
    built = build(BY_TOOL["LAFAN1"])
    certain = 0
    for _ in range(50):
        tools = rng.integers(len(CONVENTIONS), size=8)
        words = [getattr(CONVENTIONS[tools[at]], "leg" if at < 4 else "arm")[at % 4] for at in range(8)]
        names = {
            built.ours[f"{side}_{place}"][0]: f"{side}_{word or 'odd'}"
            for place, word in zip(LIMBS, words, strict=True)
            for side in ("left", "right")
        }
        left = verdict(built, lambda name, names=names: names.get(name, name))
        # Two joints of one name are refused.
        certain += not left
        assert not left or len({*names.values()}) < len(names)
    assert certain > 35
