"""Motion-X conversion: the layout fixture, repairs of columns, dirt, and equal bytes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from motionx_clips import (
    BOW,
    CHAT,
    DANCE,
    FACES,
    HUMANML,
    MIRRORED,
    MOTION,
    MUG,
    TEXTS,
    TURN,
    WAVE,
    clips_of,
    config,
)
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Manifest
from motionloom.datasets.check.dataset import check
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.motionx.convert import MotionX, parameters_to_joints
from motionloom.datasets.convert.motionx.parameters import (
    RAW,
    resample_parameters,
    scale_aist,
    stretch,
    with_face,
)
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.motion.body.smpl import BodyModel
from motionloom.datasets.motion.canonical import facing, mirror
from motionloom.datasets.motion.features.codec import decode, face_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.sample import Sample


@pytest.fixture
def fixture(shared: Path) -> Path:
    return shared / "data/layouts/motionx"


def sample(folder: Path, clip_id: str, **changes: Any) -> Sample:
    return MotionX(config(folder, **changes)).convert(clips_of(folder, **changes)[clip_id])


def convert(folder: Path, out: Path, *, workers: int = 1, **changes: Any) -> Manifest:
    return run_conversion(prepare(config(folder, **changes)), out, workers=workers, progress=False)


def rewrite(path: Path, change: Callable[[NDArray[Any]], NDArray[Any] | None]) -> None:
    """Change an array file, in place or by the array returned."""
    values = np.load(path)
    made = change(values)
    np.save(path, values if made is None else made)


def joints_of(made: Sample) -> NDArray[np.float64]:
    return decode(made.motion, MotionLayout.named(made.meta.layout, fps=made.meta.fps))


# The whole way


def test_fixture_converts(fixture: Path, tmp_path: Path) -> None:
    manifest = convert(fixture, tmp_path / "out")
    assert check(tmp_path / "out") == []
    assert {s.split: s.samples for s in manifest.shards} == {"train": 5, "val": 1, "test": 2}
    assert (manifest.layout, manifest.family, manifest.fps) == ("wholebody363", "exact", 30.0)
    assert manifest.options["body_model"]["kind"] == "neutral skeleton"
    assert str(fixture) not in manifest.model_dump_json()
    assert manifest.licences["AMASS-noncommercial"] == 2
    assert any("captions: texts/semantic_labels/ (8 files)" in note for note in manifest.notes)
    assert manifest.dropped == []


@pytest.mark.parametrize(
    ("layout", "width", "lost"),
    [("wholebody313", 313, 0), ("body133", 133, 0), ("tomato623", 623, 1), ("h3d263", 263, 1)],
)
def test_layouts(fixture: Path, layout: str, width: int, lost: int) -> None:
    made = sample(fixture, WAVE, layout=layout)
    assert made.motion.shape == (50 - lost, width)
    assert not made.meta.has_face
    assert made.meta.has_hands == (made.meta.skeleton == "smplx52")
    whole = sample(fixture, WAVE)
    if layout == "wholebody313":
        np.testing.assert_array_equal(made.motion, whole.motion[:, :313])
    plan = prepare(config(fixture, layout=layout)).plan
    assert plan.totals.frames["val"] == 44 - lost


def test_raw_layout_keeps_the_columns(fixture: Path) -> None:
    made = sample(fixture, WAVE, layout="smplx322")
    np.testing.assert_array_equal(made.motion, np.load(fixture / MOTION / f"{WAVE}.npy"))
    assert (made.meta.family, made.meta.has_face, made.meta.has_hands) == ("raw", True, True)


# Directions


def test_walking_is_forward_and_left_is_left(fixture: Path) -> None:
    joints = joints_of(sample(fixture, TURN))
    root = joints[-1, 0] - joints[0, 0]
    assert root[2] > 1.3
    assert abs(root[0]) < 0.5
    angle = np.degrees(facing(joints))
    assert abs(angle[0]) < 0.01
    assert 25 < angle[-1] < 35  # 30 degrees in the parameters; positive is to the left
    assert joints[..., 1].min() == pytest.approx(0.0, abs=1e-4)


def test_mirrored_clip_is_the_mirror_image(fixture: Path) -> None:
    plain, mirrored = sample(fixture, HUMANML), sample(fixture, MIRRORED)
    assert (plain.meta.mirror_of, mirrored.meta.mirror_of) == (None, HUMANML)
    assert plain.meta.split == mirrored.meta.split == "train"
    skeleton = MotionLayout.named("wholebody363").skeleton
    np.testing.assert_allclose(joints_of(mirrored), mirror(joints_of(plain), skeleton), atol=1e-5)


# Face and hands


def test_face_motion_is_stretched_and_written_in(fixture: Path) -> None:
    made = sample(fixture, HUMANML)
    own = np.load(fixture / MOTION / f"{HUMANML}.npy")
    face = np.load(fixture / FACES / f"{HUMANML}.npy")
    assert not own[:, 159:209].any()
    assert face.shape == (72, 153)
    wanted = torch.nn.functional.interpolate(torch.from_numpy(face).T[None], size=50, mode="linear")
    shown = face_of(made.motion, MotionLayout.named("wholebody363"))
    np.testing.assert_allclose(shown, wanted[0].T.numpy()[:, 3:53], atol=1e-6)
    assert made.meta.has_face
    raw = sample(fixture, HUMANML, layout="smplx322").motion
    np.testing.assert_allclose(raw[:, 156:309], wanted[0].T.numpy(), atol=1e-6)


def test_grab_keeps_its_jaw(copy: Path) -> None:
    path = copy / FACES / f"{MUG}.npy"
    path.parent.mkdir(parents=True)
    np.save(path, np.full((44, 153), 0.5, dtype=np.float32))
    own = np.load(copy / MOTION / f"{MUG}.npy")
    raw = sample(copy, MUG, layout="smplx322").motion
    np.testing.assert_array_equal(raw[:, 156:159], own[:, 156:159])
    assert (raw[:, 159:309] == 0.5).all()
    assert (with_face(own.astype(np.float64), np.ones((3, 153)), keep_jaw=False)[:, 156:309] == 1.0).all()


def test_a_face_without_a_text_takes_the_emotion_of_its_caption(copy: Path) -> None:
    assert [(c.text, c.source) for c in sample(copy, BOW).face_texts] == [("happy", "face")]
    shutil.rmtree(copy / "texts/face_texts")
    caption = copy / TEXTS / f"{BOW}.txt"
    caption.write_text("a person bows sadly\n")
    assert [(c.text, c.source) for c in sample(copy, BOW).face_texts] == [("sad", "emotion")]
    caption.write_text("a person bows\n")
    assert sample(copy, BOW).face_texts == [], "none is made up"
    caption.write_text("a person bows sadly\n")
    rewrite(copy / MOTION / f"{BOW}.npy", lambda values: values[:, 159:209].fill(0))
    shutil.rmtree(copy / "face_motion_data")
    made = sample(copy, BOW)
    assert not made.meta.has_face and made.face_texts == []


def test_absent_face_and_hands_are_masked(copy: Path) -> None:
    shutil.rmtree(copy / "face_motion_data")
    made = sample(copy, HUMANML)
    assert not made.meta.has_face
    assert not face_of(made.motion, MotionLayout.named("wholebody363")).any()

    def no_hands(values: NDArray[Any]) -> None:
        values[:, 66:156] = 0

    rewrite(copy / MOTION / f"{CHAT}.npy", no_hands)
    made = sample(copy, CHAT)
    assert (made.meta.has_hands, made.meta.has_face) == (False, True)


# aist


def test_dances_are_scaled_exactly_once(copy: Path) -> None:
    path = copy / MOTION / f"{DANCE}.npy"
    once = sample(copy, DANCE)
    joints = joints_of(once)
    assert 4.0 < joints[-1, 0, 2] < 4.4  # forward, in metres

    def script(values: NDArray[Any]) -> None:
        values[:, 309:312] /= 94
        values[:, 311] *= -1

    rewrite(path, script)
    np.testing.assert_allclose(sample(copy, DANCE).motion, once.motion, atol=1e-5)
    values = np.load(path).astype(np.float64)
    np.testing.assert_array_equal(scale_aist(values), values)

    rewrite(path, script)
    with pytest.raises(UserError, match="run twice"):
        sample(copy, DANCE)


# Dirt


def test_resampled_parameters_turn_evenly(fixture: Path) -> None:
    """20 from 30 fps: every second output frame is an input frame, and joints stay near those in between."""
    values = MotionX(config(fixture)).parameters(clips_of(fixture)[WAVE])
    slow = resample_parameters(values, 30.0, 20.0)
    assert len(slow) == 33
    body = BodyModel.neutral("smplx52")
    fast_joints, joints = parameters_to_joints(values, body), parameters_to_joints(slow, body)
    np.testing.assert_allclose(joints[::2], fast_joints[::3], atol=1e-9)
    between = (fast_joints[1:-1:3] + fast_joints[2::3]) / 2
    assert np.abs(joints[1::2] - between[: len(joints[1::2])]).max() < 0.01


def test_body_model_gives_shapes(fixture: Path, amass: ModuleType, tmp_path: Path) -> None:
    """A made-up SMPL-X model: the neutral joints as vertices, one shape value that scales all of them."""
    path = amass.body_model(tmp_path / "model.npz", 55, 1.0)
    conversion = prepare(config(fixture, body_model=path))
    assert conversion.options["body_model"]["kind"] == "SMPL-X"
    assert str(tmp_path) not in json.dumps(conversion.options)
    made = conversion.converter.convert(clips_of(fixture)[BOW])
    assert isinstance(made, Sample)
    beta = float(np.median(np.load(fixture / MOTION / f"{BOW}.npy")[:, 312]))
    skeleton = BodyModel.neutral("smplx52").skeleton
    knee, ankle = skeleton.index("left_knee"), skeleton.index("left_ankle")
    bones = [
        np.linalg.norm(joints[0, ankle] - joints[0, knee])
        for joints in (joints_of(made), joints_of(sample(fixture, BOW)))
    ]
    assert bones[0] / bones[1] == pytest.approx(1 + 0.05 * beta, abs=1e-4)
    assert beta != 0
    with pytest.raises(UserError, match=r"none\.npz"):
        prepare(config(fixture, body_model=tmp_path / "none.npz"))


def test_golden_slices_and_mirror(shared: Path) -> None:
    with np.load(shared / "golden/t4_motionx322_A.npz") as golden:
        values, mirrored = (golden[name].astype(np.float64) for name in ("motion322", "mirrored"))
        slices = {name: golden[f"slice_{name}"] for name in (
            "root_orient", "pose_body", "pose_hand", "pose_jaw", "face_expr", "face_shape", "trans", "betas"
        )}  # fmt: skip
    for name, (start, stop) in slices.items():
        assert RAW.slice("face" if name == "face_expr" else name) == slice(start, stop)
    body = BodyModel.neutral("smplx52")
    ours = parameters_to_joints(values, body)
    np.testing.assert_allclose(parameters_to_joints(mirrored, body), mirror(ours, body.skeleton), atol=1e-6)


@pytest.mark.parametrize(("before", "after"), [(72, 50), (50, 72), (1, 5), (7, 1), (4, 4)])
def test_stretch_is_torch_interpolate(before: int, after: int) -> None:
    values = np.random.default_rng(0).standard_normal((before, 3))
    wanted = torch.nn.functional.interpolate(torch.from_numpy(values).T[None], size=after, mode="linear")
    np.testing.assert_allclose(stretch(values, after), wanted[0].T.numpy(), atol=1e-12)
