"""BVH conversion without a joint map (a guess for each skeleton) and without fingers."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bvh_clips import write_clip, write_map
from foreign_figures import Built, build, write_figure
from foreign_tools import FOREIGN
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Manifest, Split
from motionloom.datasets.convert.bvh.convert import BvhConfig
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.motion.body.resting_hands import with_resting_hands
from motionloom.datasets.motion.bvh.joint_map import JointMap
from motionloom.datasets.motion.bvh.motion import read_bvh
from motionloom.datasets.motion.canonical import canonicalize, resample
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.shards.reader import ShardDataset

BY_TOOL = {spec.tool: spec for spec in FOREIGN}
LAFAN1 = BY_TOOL["LAFAN1"]
SPLITS: tuple[Split, ...] = ("train", "val", "test")


def convert(source: Path, out: Path, **changes: Any) -> Manifest:
    config = BvhConfig(source=source, licence="CC0", name="x", **changes)
    prepared = prepare(config, out=out)
    return run_conversion(prepared, out, progress=False)


def joints_by_id(folder: Path) -> dict[str, NDArray[np.float64]]:
    """Decoded joints of every clip of a data set."""
    found = {}
    for split in SPLITS:
        if list(folder.glob(f"*-{split}-*.tar")):
            dataset = ShardDataset.open(folder, split)
            for i, clip_id in enumerate(dataset.ids):
                found[clip_id] = decode(np.array(dataset.motion(i), np.float64), dataset.layout)
    return found


def true_joints(built: Built, world: NDArray[np.float64], layout: MotionLayout) -> NDArray[np.float64]:
    index = {name: i for i, name in enumerate(built.names)}
    rows = [[index[name] for name in built.ours[joint]] for joint in layout.skeleton.joints]
    joints = np.stack([world[:, row].mean(axis=1) for row in rows], axis=1)
    return canonicalize(resample(joints, 60.0, layout.fps))


def test_one_folder_of_every_tool(tmp_path: Path) -> None:
    """Two clips of each skeleton, with bones of different lengths: one guess for both."""
    layout = MotionLayout.named("body133")
    expected = {}
    for number, spec in enumerate(FOREIGN):
        for take, size in enumerate((1.0, 1.1)):
            built = build(spec, a_pose=bool(take))
            built.points = [point * size for point in built.points]
            path = tmp_path / "mocap" / f"{number:02}-{take}.bvh"
            world = write_figure(path, built, twisted=bool(number % 2), frames=66, seed=10 * number + take)
            expected[path.stem] = true_joints(built, world, layout)
    manifest = convert(tmp_path / "mocap", tmp_path / "out")
    assert not manifest.dropped
    found = joints_by_id(tmp_path / "out")
    assert set(found) == set(expected)
    for clip_id, joints in expected.items():
        # Features are float32, and the root's path is a sum of 21 steps: 1e-4 m is some hundred roundings.
        np.testing.assert_allclose(found[clip_id], joints, atol=1e-4, err_msg=clip_id)
    written = {JointMap.load(path).sources for path in (tmp_path / "out/joint_maps").iterdir()}
    assert written == {tuple(build(spec).ours[joint] for joint in layout.skeleton.joints) for spec in FOREIGN}


@pytest.mark.parametrize("tool", ["BONES, SOMA 77", "Mixamo"])
def test_hands_come_along_in_a_layout_that_has_them(tool: str, tmp_path: Path) -> None:
    built = build(BY_TOOL[tool])
    options: dict[str, Any] = {"layout": "wholebody313", "fps": 30.0, "unit": "m", "up": "z"}
    write_figure(tmp_path / "mocap/a.bvh", built, unit="m", up="z", frames=66)
    convert(tmp_path / "mocap", tmp_path / "guessed", **options)
    target = Skeleton.named("smplx52")
    own = JointMap("", target, tuple(built.ours[joint] for joint in target.joints))
    (tmp_path / "map.json").write_text(own.text("by hand"))
    convert(tmp_path / "mocap", tmp_path / "own", joint_map=tmp_path / "map.json", **options)
    guessed, by_hand = joints_by_id(tmp_path / "guessed")["a"], joints_by_id(tmp_path / "own")["a"]
    assert guessed.shape[-2] == 52
    np.testing.assert_array_equal(guessed, by_hand)


def toeless(folder: Path) -> Path:
    """A clip whose toes nothing tells from its heels."""
    built = build(dataclasses.replace(LAFAN1, leg=(*LAFAN1.leg[:3], "{}A@foot")))
    for side in ("Left", "Right"):
        ankle = built.names.index(f"{side}Foot")
        built.add(f"{side}B", ankle, built.points[ankle] + [0.0, -0.06, -0.05])
    write_figure(folder / "a.bvh", built, frames=66)
    return folder


def test_what_is_not_certain_is_refused_with_a_map_to_complete(tmp_path: Path) -> None:
    source, out = toeless(tmp_path / "mocap"), tmp_path / "out"
    with pytest.raises(UserError, match="no joint for left_foot, right_foot") as e:
        convert(source, out)
    (path,) = (out / "joint_maps").iterdir()
    assert str(path) in str(e.value) and f"--set joint_map={path.parent}" in str(e.value)
    with pytest.raises(UserError, match="to be filled in"):
        convert(source, out, joint_map=path)
    fill_in(path)
    assert not convert(source, tmp_path / "other", joint_map=path).dropped
    assert not convert(source, out).dropped, "what a hand has filled in counts"


def fill_in(path: Path) -> None:
    data = json.loads(path.read_text())
    for row, name in ((10, "LeftA"), (11, "RightA")):
        assert data["smpl22"][row][2] is None
        data["smpl22"][row][2] = name
    path.write_text(json.dumps(data))


def test_maps_are_for_their_own_skeletons(tmp_path: Path) -> None:
    """Certain and uncertain skeletons in one folder: a completed map leaves the others alone."""
    source, out = toeless(tmp_path / "mocap"), tmp_path / "out"
    for tool in ("Mixamo", "LAFAN1", "Rokoko"):
        write_figure(source / f"{tool}.bvh", build(BY_TOOL[tool]), frames=66)
    manifest = convert(source, out)
    assert ["joint map" in d.reason for d in manifest.dropped if d.source == "a.bvh"] == [True]
    assert len(manifest.dropped) == 1
    assert any("a.bvh is not certain" in note for note in manifest.notes)
    (path,) = (path for path in (out / "joint_maps").iterdir() if "null" in path.read_text())
    assert len(list(path.parent.iterdir())) == 4
    fill_in(path)
    for number, given in enumerate((path, path.parent)):
        assert not convert(source, tmp_path / f"out-{number}", joint_map=given).dropped
    metres = json.loads(path.read_text()) | {"unit": "m"}
    path.write_text(json.dumps(metres))
    (drop,) = convert(source, tmp_path / "out-2", joint_map=path, look=0).dropped
    assert drop.source == "a.bvh" and "read with unit 'm'" in drop.reason
    (source / "a.bvh").unlink()
    with pytest.raises(UserError, match="no file"):
        convert(source, tmp_path / "out-3", joint_map=path)


@pytest.mark.parametrize("tool", ["LAFAN1", "Mixamo", "Bandai-Namco"])
def test_files_that_sort_first_and_captions_change_no_map(tool: str, tmp_path: Path) -> None:
    """The two first commands of the documents, and a folder that grows at its beginning."""
    source, out = tmp_path / "mocap", tmp_path / "out"
    for take in range(2):
        write_figure(source / f"{5 + take}.bvh", build(BY_TOOL[tool]), frames=66, seed=take)
    plan_of = prepare(BvhConfig(source=source), out=out).plan
    (path,) = (out / "joint_maps").iterdir()
    before = path.read_bytes()
    captions = tmp_path / "c.csv"
    captions.write_text("file,caption\n6.bvh,a person walks\n")
    first = convert(source, out, captions=captions, uncaptioned="keep")
    assert len(plan_of.items) == sum(shard.samples for shard in first.shards) == 2
    write_figure(source / "0.bvh", build(BY_TOOL[tool], a_pose=True), frames=66, seed=9)
    more = convert(source, out, captions=captions, uncaptioned="keep")
    assert sum(shard.samples for shard in more.shards) == 3 and path.read_bytes() == before


def test_a_source_that_is_mostly_rejected_fails(tmp_path: Path) -> None:
    source, out = toeless(tmp_path / "mocap"), tmp_path / "out"
    text = (source / "a.bvh").read_text()
    for take in range(3):
        (source / f"b{take}.bvh").write_text(text + "\n" * take)
    write_figure(source / "good.bvh", build(LAFAN1), frames=66)
    with pytest.raises(UserError, match=r"3 of 4.*left-out\.txt.*most_rejected=1"):
        convert(source, out)
    assert Manifest.load_json(out / "manifest.json").shards
    assert convert(source, out, most_rejected=1).shards


def test_a_guess_needs_no_whole_first_file_and_no_folder(tmp_path: Path) -> None:
    source = tmp_path / "mocap"
    for name in ("a", "b"):
        write_figure(source / f"{name}.bvh", build(LAFAN1), frames=66, seed=ord(name))
    text = (source / "a.bvh").read_text()
    (source / "a.bvh").write_text(text[: -len(text) // 3])
    config = BvhConfig(source=source, licence="CC0")
    prepared = prepare(config)
    (note,) = (note for note in prepared.plan.notes if "guessed from b.bvh" in note)
    assert "22 by name" in note
    assert not [p for p in tmp_path.rglob("*") if p.suffix != ".bvh" and p.is_file()]
    manifest = convert(source, tmp_path / "out")
    assert [d.source for d in manifest.dropped] == ["a.bvh"]
    again = prepare(config, out=tmp_path / "out")
    assert again.options == prepared.options, "neither the folder nor an earlier run matters"
    toeless(tmp_path / "other")
    with pytest.raises(UserError, match=r"a\.bvh is not certain"):
        prepare(BvhConfig(source=tmp_path / "other", licence="CC0"))


@pytest.mark.parametrize(
    ("metres", "up", "tells"),
    [
        (1.0, "y", "1 m (m)"),
        (0.1, "z", "0.1 m (dm)"),
        (0.3048, "y", "0.3048 m (foot)"),
        (0.0254 / 0.45, "z", "0.05644 m (inch/0.45)"),
        (0.0254, "y", "0.0254 m (inch)"),
        (0.018, "z", "no known unit fits"),
        (0.55, "y", "no known unit fits"),
    ],
)
def test_unit_and_axis_are_settled_by_the_figures(metres: float, up: Any, tells: str, tmp_path: Path) -> None:
    built = build(LAFAN1)
    built.points = [point / metres for point in built.points]
    world = write_figure(tmp_path / "mocap/a.bvh", built, unit="m", up=up, frames=66) * metres
    # The path through the room is not scaled, so that the root's height is another one: the bones count.
    prepared = prepare(BvhConfig(source=tmp_path / "mocap", licence="CC0"), out=tmp_path / "out")
    (note,) = (note for note in prepared.plan.notes if note.startswith("unit by body size, from a.bvh"))
    assert tells in note
    assert any("upward axis" in note for note in prepared.plan.notes) is (up == "z")
    read = prepared.converter.joints(prepared.plan.items[0][1]).joints
    own = [built.names.index(built.ours[joint][0]) for joint in ("left_hip", "left_knee", "head")]
    ours = [Skeleton.named("smpl22").index(joint) for joint in ("left_hip", "left_knee", "head")]
    scale = np.linalg.norm(np.diff(read[:, ours], axis=1), axis=-1) / np.linalg.norm(
        np.diff(world[:, own], axis=1), axis=-1
    )
    # A known unit is exact; a scale by size makes 1.7 m of our 1.55 m figure, within its sway.
    np.testing.assert_allclose(scale, 1.0, atol=0.15 if "no known" in tells else 1e-4)


def test_one_skeleton_in_two_units(tmp_path: Path) -> None:
    for unit in ("cm", "m"):
        write_figure(tmp_path / f"mocap/{unit}.bvh", build(LAFAN1), unit=unit, frames=66)
    path = tmp_path / "mocap/cm.bvh"
    path.write_text(path.read_text().replace("Frames: 66", "Frames: 67"))  # as a stopped recorder leaves it
    manifest = convert(tmp_path / "mocap", tmp_path / "out")
    assert not manifest.dropped and any("a row off in 1" in note for note in manifest.notes)
    joints = joints_by_id(tmp_path / "out")
    np.testing.assert_allclose(joints["cm"], joints["m"], atol=1e-4)


@pytest.mark.parametrize("pose", ["T", "A", "the same", "bent"])
def test_an_added_first_pose_is_left_out(pose: str, tmp_path: Path) -> None:
    """A rest pose in front of a motion that begins elsewhere; not a first frame that belongs to it."""
    path = tmp_path / "mocap/a.bvh"
    write_figure(path, build(LAFAN1, a_pose=pose == "A"), frames=66)
    plain = read_bvh(path)
    head, _, body = path.read_text().partition("Frames: 66")
    lines = body.splitlines()
    rest = [0.0] * plain.values.shape[1]
    rest[:3] = plain.values[0, :3] + [0.0, 0.0, 40.0]
    start = 6 if pose == "the same" else 0  # a step among steps
    first = lines[2].split() if start else list(map(str, rest))
    if pose == "bent":
        first[3 + 3 * plain.joints.index("LeftLeg") + 2] = "70"
    path.write_text("\n".join([f"{head}Frames: 67", lines[1], " ".join(first), *lines[2:]]) + "\n")
    manifest = convert(tmp_path / "mocap", tmp_path / "out", look=0)
    told = any("added T-pose" in note for note in manifest.notes)
    assert told is (pose in "TA")
    (frames,) = (shard.frames for shard in manifest.shards if shard.samples)
    assert frames == len(np.arange(0, (66 if told else 67) / 60 - 1e-9, 1 / 20))


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clips")
    write_clip(folder / "sway.bvh", 1)
    return folder


@pytest.mark.parametrize("fingers", ["resting", "missing"])
def test_hands_are_added_and_the_body_stays(clips: Path, tmp_path: Path, fingers: str) -> None:
    manifest = convert(clips, tmp_path / "whole", look=0, layout="wholebody363", fingers=fingers)
    convert(clips, tmp_path / "body", look=0)
    (shard,) = (one for one in manifest.shards if one.samples)
    whole, body = (ShardDataset.open(tmp_path / name, shard.split) for name in ("whole", "body"))
    layout = MotionLayout.named("wholebody363", fps=20.0)
    assert whole.layout == layout
    assert whole.meta(0).has_hands is (fingers == "resting") and not whole.meta(0).has_face
    motion = np.array(whole.motion(0))
    np.testing.assert_allclose(motion[:, layout.part("body")], np.array(body.motion(0)), atol=1e-5)
    assert not motion[:, layout.slice("face")].any()
    joints = decode(motion, layout)
    # Made at 30 fps and resampled along straight lines: close, not equal.
    np.testing.assert_allclose(joints, with_resting_hands(joints[:, :22]), atol=0.01)


def test_a_map_without_fingers_is_refused_where_fingers_are_recorded(clips: Path, tmp_path: Path) -> None:
    path = write_map(tmp_path / "map.json")
    with pytest.raises(UserError, match="'smplx52'; found smpl22"):
        convert(clips, tmp_path / "out", layout="wholebody313", joint_map=path, look=0)
    convert(clips, tmp_path / "out", layout="wholebody313", joint_map=path, fingers="resting", look=0)


def test_a_plan_needs_no_licence_and_a_conversion_does(clips: Path, tmp_path: Path) -> None:
    config = BvhConfig(source=clips)
    prepared = prepare(config, out=tmp_path / "out")
    assert prepared.plan.items
    with pytest.raises(UserError, match="--set licence="):
        run_conversion(prepared, tmp_path / "out", progress=False)
