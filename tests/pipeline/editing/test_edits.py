"""Edits of clips: one figure, what is kept of it, what is asked for met, and what cannot be done refused."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from toy_stages import FixedEncoder, MadeStage

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.convert.common.features import features_of
from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.motion.body.rigid import fit_rigid
from motionloom.datasets.motion.canonical import canonicalize, ground, mirror
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import CompletedStage, StageCache
from motionloom.pipeline.editing.edit import EditedMotion, changed, edit_clip, original_of
from motionloom.pipeline.editing.finish import finish
from motionloom.pipeline.editing.frames import edit_frames
from motionloom.pipeline.editing.generator import InBetweenMotion
from motionloom.pipeline.editing.inbetween.filling import Filling
from motionloom.pipeline.editing.inbetween.network import InBetweenConfig, InBetweener
from motionloom.pipeline.editing.task import EditTask
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.clip_file import RecordedClip, read_clip, require_clip
from motionloom.pipeline.inference.shipped_models import shipped_models

Walk = Callable[..., NDArray[np.float64]]
FEW = SamplingConfig(denoising_steps=3)
ENDS = [{"end": 1.0}, {"start": 2.0}]


def stage(made: Any) -> CompletedStage:
    return CompletedStage("stage", MadeStage(made), None, Path(f"stage-{made.part}"), {})


def editor(name: str = "wholebody363") -> Bundle:
    """An untrained model that edits."""
    torch.manual_seed(0)
    layout = MotionLayout.named(name, fps=20.0)
    # Statistics of somebody who stands: an untrained network then strays from that by centimetres.
    rest = canonicalize(np.repeat(layout.skeleton.rest_joints[None], 9, axis=0))
    stats = FeatureStats(encode(rest, layout)[0], np.full(layout.dim, 0.02, np.float32), layout)
    given = {"stats": stats, "text": SimpleNamespace(encoder=FixedEncoder())}
    config = InBetweenConfig(dim=16, ff=16, layers=1, heads=2)
    net = InBetweener(config, layout.dim, 8).eval()
    return Bundle([stage(InBetweenMotion(layout, "all", given, net, window=40))], StageCache())


def clip(walk: Walk, seconds: float = 3.0, fps: float = 20.0) -> RecordedClip:
    """A walk that begins somewhere and faces somewhere, with a face."""
    frames = round(seconds * fps)
    joints = walk(frames=frames, fps=fps) + np.array([1.0, 0.2, -2.0])
    face = np.random.default_rng(0).normal(size=(frames, 50)).astype(np.float32)
    return RecordedClip("walk", joints, fps, face)


def edit(model: Bundle, one: RecordedClip, **task: object) -> EditedMotion:
    [made] = edit_clip(model, one, EditTask.parse(task, "task"), 1, 0, FEW)
    return made


@pytest.mark.parametrize("name", ["wholebody363", "body133", "tomato623"])
def test_kept_frames_are_the_clips_own(walk: Walk, name: str) -> None:
    model, one = editor(name), clip(walk)
    made = edit(model, one, keep=ENDS)
    original, kept = made.original, np.ones(len(made.joints), dtype=bool)
    kept[20:40] = False
    np.testing.assert_allclose(made.joints[kept], original.joints[kept], atol=1e-9)
    assert made.report.kept_cm < 1e-4
    assert np.abs(made.joints - original.joints)[~kept].max() > 0.01
    # In the clip's own world, whose floor is at 0.
    floor = one.joints[..., 1].min()
    np.testing.assert_allclose(
        original.joints[:, :22], one.joints[: len(kept), :22] - [0, floor, 0], atol=0.03
    )
    # The features decode to these joints, from the first frame on.
    local = joints_of(made.features, made.layout)
    decoded, shown = (np.abs(ground(one)[:, :1] - ground(one)[:1, :1]) for one in (local, made.joints))
    assert np.abs(decoded - shown).max() < 0.05
    if name == "wholebody363":
        assert made.face is not None and original.face is not None
        np.testing.assert_array_equal(made.face[kept], original.face[kept])


@pytest.mark.parametrize(
    ("keep", "free"),
    [
        ({"parts": ["lower"]}, {"spine2", "head", "left_wrist", "right_thumb3"}),
        ({"parts": ["all"], "but": ["right_hand"]}, {"right_index2", "right_thumb3"}),
        ({"parts": ["all"], "but": ["left_arm", "left_hand"]}, {"left_elbow", "left_wrist", "left_pinky2"}),
        ({"parts": ["all"], "but": ["face"]}, set()),
    ],
)
def test_parts_are_kept_alone(walk: Walk, keep: dict[str, object], free: set[str]) -> None:
    made = edit(editor(), clip(walk), keep=[keep])
    names = made.layout.skeleton.joints
    moved = np.abs(made.joints - made.original.joints).max(axis=(0, 2)) > 1e-6
    found = {name for name, one in zip(names, moved, strict=True) if one}
    assert free <= found
    assert not found & {"pelvis", "left_knee", "right_foot"}
    assert made.report.kept_cm < 1e-4
    assert made.face is not None and made.original.face is not None
    face_kept = keep["parts"] == ["all"] and keep.get("but") != ["face"]
    assert np.array_equal(made.face, made.original.face) == face_kept


def test_a_clip_is_mirrored_retimed_and_repeated_without_a_model(
    walk: Walk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Filling, "__call__", None)
    twice = edit(editor(), clip(walk), mirror=True, speed=2.0, repeat=2)
    assert len(twice.joints) == 59 and twice.report.kept_cm < 1e-4
    there = mirror(twice.joints[:30], twice.layout.skeleton) - twice.original.joints[::2]
    assert np.ptp(there - there[0, 0], axis=0).max() < 0.05, "frames of the clip, somewhere else"
    steps = np.linalg.norm(np.diff(twice.joints, axis=0), axis=-1).max(axis=1)
    assert steps[29] < 1.5 * steps[:29].max(), "no jump where it begins again"
    figure = fit_rigid(clip(walk).joints, twice.layout.skeleton)
    figure.rotations[:, 15] = Rotation.from_euler("x", 40, degrees=True).as_matrix()
    again = changed(replace(clip(walk), posed=figure), EditTask(repeat=2)).posed
    assert again is not None and len(again.root) == 119
    heads = again.rotations[:, 15].swapaxes(-1, -2) @ figure.rotations[0, 15]
    assert Rotation.from_matrix(heads).magnitude().max() < 0.1, (
        "positions alone do not show that it looks down"
    )


def test_before_after_and_between(walk: Walk) -> None:
    made = edit(editor(), clip(walk), lead=0.5, seconds=4.0)
    assert len(made.joints) == 10 + 80
    np.testing.assert_allclose(made.joints[10:70], made.original.joints, atol=1e-9)
    longer = edit(editor(), clip(walk, 6.0), keep=[{"end": 2.5}, {"start": 3.0}])  # windows of 2 s
    assert longer.report.kept_cm < 1e-4
    legs = edit(editor(), clip(walk), keep=[{"parts": ["upper"]}])
    assert legs.report.kept_cm < 1e-4 and np.abs(legs.joints - legs.original.joints)[:, 7].max() > 0.01


def test_path_and_pins_are_met(walk: Walk) -> None:
    model, one = editor(), clip(walk)
    path = [{"at": 0, "x": 1, "z": -2}, {"at": 1.5, "x": 1.5, "z": -1}, {"at": 2.5, "x": 2.5, "z": -0.5}]
    made = edit(model, one, path=path)
    assert made.report.path_cm < 1
    np.testing.assert_allclose(made.joints[30, 0, [0, 2]], [1.5, -1], atol=0.01)
    assert made.report.aside_degrees < 20, "it faces where it goes"
    start = one.joints[0]
    assert abs(ground(made.joints[0, 0]) - ground(start[0])) < 0.01

    hand = one.joints[30, 20] + [0.05, -0.2, 0.1]  # the floor of the clip is 0.2 m up
    pin = {"at": 1.5, "joint": "left_wrist", "position": hand.tolist()}
    made = edit(model, one, keep=ENDS, pins=[pin])
    [miss] = made.report.pins_cm.values()
    assert miss < 0.1
    assert made.report.kept_cm < 1e-4
    forearm = np.linalg.norm(made.joints[:, 20] - made.joints[:, 18], axis=-1)
    assert np.ptp(forearm) < 1e-9, "the figure is rigid"
    with pytest.raises(UserError, match=r"left_wrist at 1.50 s is out of reach: .* \d+\.\d cm"):
        edit(model, one, keep=ENDS, pins=[{**pin, "position": [50.0, 1.0, 0.0]}])


def test_other_rates_bones_and_missing_hands_are_said(walk: Walk) -> None:
    tall = clip(walk, fps=40.0)
    tall = RecordedClip("tall", tall.joints[:, :22] * 1.2, 40.0)
    made = edit(editor(), tall, keep=ENDS)
    assert len(made.joints) == 60
    for word in ("40 frames/s", "hands are not recorded", "no face"):
        assert any(word in remark for remark in made.remarks)
    kept = np.r_[0:20, 40:60]
    np.testing.assert_allclose(made.joints[kept, :22], made.original.joints[kept, :22], atol=1e-9)
    bones = np.linalg.norm(made.joints[:, 4] - made.joints[:, 1], axis=-1)  # a thigh
    np.testing.assert_allclose(bones, bones[0], rtol=1e-9)


def test_a_figure_on_other_bones_stands_where_the_clip_does(walk: Walk) -> None:
    """Long shins, so that the share of the feet in its height is not the model's."""
    long = walk(frames=60, fps=20.0)
    for side in (7, 8):
        below = [side, side + 3]
        shin = long[:, side] - long[:, side - 3]
        long[:, below] += 0.5 * shin[:, None]
    long[..., 1] -= long[..., 1].min()
    layout = MotionLayout.named("wholebody363", fps=20.0)
    one = RecordedClip("long", long, 20.0)
    frames = edit_frames(EditTask.parse({"keep": ENDS}, "task"), one, layout)
    assert frames.scale != 1.0
    joints = finish(frames, frames.known.features[:, layout.part("bodyhand")])[1].joints
    off = np.linalg.norm(joints[20:40] - original_of(frames, one).joints[20:40], axis=-1)
    assert off.max() < 0.02


def test_motions_and_their_files_are_clips(walk: Walk, tmp_path: Path) -> None:
    made = edit(editor(), clip(walk), keep=ENDS, caption="a person walks")
    again = [read_clip(made.save(tmp_path / f"clip.{ending}")) for ending in ("npz", "bvh", "glb")]
    for one in again:
        assert one.fps == 20 and one.joints.shape == (60, 52, 3)
        np.testing.assert_allclose(one.joints, made.joints, atol=1e-3)
    assert again[0].caption == "a person walks"
    # A figure of ours comes back with its bones, its rate and the numbers of what is kept.
    stored = dict(np.load(tmp_path / "clip.npz"))
    np.savez(tmp_path / "fast.npz", **stored | {"metadata": np.array('{"fps": 30}')})
    for name, rows in {
        "clip.npz": np.r_[0:20, 30:60], "clip.glb": np.r_[0:20, 30:60], "fast.npz": np.r_[0:30, 45:60]
    }.items():  # fmt: skip
        one = read_clip(tmp_path / name)
        made_again = edit(editor(), one, keep=[{"end": 1.0}, {"start": 1.5}])
        path = made_again.save(tmp_path / f"made{Path(name).suffix}")
        found = read_clip(path)
        assert found.fps == one.fps and found.figure is not None and one.figure is not None
        assert made_again.report.kept_cm < 1e-3
        assert len(found.joints) == 60 and np.abs(found.joints - one.joints).max() > 0.01
        tolerance = 1e-6 if path.suffix == ".glb" else 0.0
        for field in ("joints", "rotations", "root"):
            numbers = [getattr(each.figure, field)[rows] for each in (found, one)]
            np.testing.assert_allclose(*numbers, rtol=0, atol=tolerance)
        np.testing.assert_allclose(*(each.figure.skeleton.offsets for each in (found, one)), atol=1e-7)
    # A BVH that is read comes back with its own text, also when the result is edited again.
    text = (tmp_path / "clip.bvh").read_bytes().replace(b"\n", b"\r\n")
    (tmp_path / "clip.bvh").write_bytes(b"\xef\xbb\xbf" + text)
    again[1] = read_clip(tmp_path / "clip.bvh")
    made = edit(editor(), again[1], keep=ENDS)
    rows = [text, made.save(tmp_path / "made.bvh").read_bytes().removeprefix(b"\xef\xbb\xbf")]
    before, after = (text.split(b"\r\n")[:-1] for text in rows)
    assert rows[0] != rows[1] and b"\n" not in b"".join(after)
    miss = np.abs(made.joints[10:15] - made.original.joints[10:15]).max() + made.report.kept_cm
    assert miss < 1e-9
    start = len(before) - 60
    assert before[: start + 20] == after[: start + 20] and before[-20:] == after[-20:]
    assert all(one != two for one, two in zip(before[start + 20 : -20], after[start + 20 : -20], strict=True))
    height = again[1].joints[0, 0, 1] - made.original.joints[0, 0, 1]  # the file has a floor of its own
    found = read_clip(tmp_path / "made.bvh").joints
    np.testing.assert_allclose(found, made.joints + np.array([0, height, 0]), atol=0.01)
    assert made.original.bvh is again[1].bvh
    upper = edit(editor(), again[1], keep=[{"parts": ["upper"]}])
    assert upper.bvh is None and any("skeleton of ours" in remark for remark in upper.remarks)


REFUSED: list[tuple[dict[str, object], str]] = [
    ({"keep": [{}]}, "keep"),
    ({}, "nothing else"),
    ({"keep": [{"start": 9.0}]}, "keep.0: .*9 s.*3.00 s"),
    ({"keep": ENDS, "pins": [{"at": 1.5, "joint": "tail", "position": [0, 1, 0]}]}, "pins: .*'tail'"),
    ({"keep": ENDS, "pins": [{"at": 0.5, "joint": "head", "position": [0, 1, 0]}]}, "pins: head .*0.5 s"),
    ({"keep": ENDS, "pins": [{"at": 9, "joint": "head", "position": [0, 1, 0]}]}, "0 s to 2.95 s"),
    ({"path": [{"at": 0, "x": 0, "z": 0}, {"at": 1, "x": 90, "z": 0}]}, "path: .* m/s on the way to .* s"),
    ({"path": [{"at": 1, "x": 0, "z": 0}, {"at": 1, "x": 1, "z": 0}]}, "path: 1 s"),
    ({"keep": ENDS, "path": [{"at": 0.5, "x": 0, "z": 0}]}, "path: .*0.5 s"),
    ({"keep": [{"parts": ["leg"]}]}, "keep.0.parts.0"),
    ({"seconds": 6.1}, "knows motions of 2 s .* at most 3 s"),
    ({"keeps": []}, "'keep'"),
]  # fmt: skip


@pytest.mark.parametrize(("task", "said"), REFUSED)
def test_what_cannot_be_done_is_refused_in_one_sentence(
    walk: Walk, task: dict[str, object], said: str
) -> None:
    with pytest.raises(UserError, match=said) as error:
        edit(editor(), clip(walk), **task)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("frames", "fps", "said"),
    [
        (3000, 1 / 1.15, "3,000 frames at 0.87 a second, 57 min, are too few"),
        (16_000, 20.0, "13.3 min of motion"),
    ],
)
def test_long_and_slow_clips_are_refused_before_a_frame_is_made(
    walk: Walk, frames: int, fps: float, said: str
) -> None:
    recorded = RecordedClip("slow", np.resize(walk(100, fps), (frames, 52, 3)), fps)
    tracemalloc.start()
    for task in ({}, {"keep": ENDS}):
        with pytest.raises(UserError, match=said):
            edit(editor(), recorded, **task)
    assert tracemalloc.get_traced_memory()[1] < recorded.joints.nbytes
    tracemalloc.stop()
    if fps < 1:
        with pytest.raises(UserError, match="too few"):
            features_of(recorded.joints, fps, MotionLayout.named("body133"))


def test_what_is_no_clip_is_refused(walk: Walk, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="walk: the figure measures"):
        require_clip(RecordedClip("walk", walk(frames=9) * 100, 20.0))
    for name, words in (("none.npz", "no such file"), ("clip.fbx", "ends in .bvh, .amc, .npz, .glb")):
        with pytest.raises(UserError, match=name) as error:
            read_clip(tmp_path / name)
        assert words in str(error.value)


@pytest.fixture
def inbetween() -> Path:
    """The folder of the in-betweener that ships."""
    if "inbetween" not in shipped_models():
        pytest.skip("this tree has no weights in models/pretrained/inbetween")
    return shipped_models()["inbetween"].folder


def test_the_command_fills_a_gap_beside_the_clip(
    walk: Walk, inbetween: Path, call: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Smoother than twice the clip's own steps at the seams, by the model that ships and a task file."""
    monkeypatch.chdir(tmp_path)
    facts = np.array('{"fps": 20, "caption": "a person walks"}')
    np.savez("walk.npz", joints=clip(walk).joints, metadata=facts)
    Path("task.yaml").write_text("keep: [{end: 1.0}, {start: 2}]\ncaption: a person walks forward\n")
    made = call("edit", "inbetween", "walk.npz", "--task", "task.yaml", "-f", "npz,html")
    assert made.code == 0, made.err
    assert [Path(line).name for line in made.out.split()] == [
        "00-walk.npz", "01-walk-edited.npz", "index.html",
    ]  # fmt: skip
    assert "kept joints: 0.00 cm" in made.err and "the clip has no face" in made.err
    before, after = (read_clip(Path(line)).joints for line in made.out.split()[:2])
    steps = [np.linalg.norm(np.diff(one, axis=0), axis=-1).max() for one in (before, after)]
    assert steps[1] < 2 * steps[0]
    assert np.abs(after - before)[20:40].max() > 0.02
