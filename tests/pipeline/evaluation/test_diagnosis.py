"""Where a model errs: errors of joints, actions shown for others, the worst and best clips on a page."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import FINGERS, WRISTS
from motionloom.datasets.synth.generate import SynthConfig, make_sample
from motionloom.pipeline.contract.showing import Confusions, JointErrors
from motionloom.pipeline.evaluation.clip_metrics import Performance
from motionloom.pipeline.evaluation.diagnosis import (
    Diagnosis,
    as_shown,
    confusions,
    extremes,
    joint_distances,
    showings,
)
from motionloom.pipeline.evaluation.truth import Truth
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.viewer import Clips
from motionloom.pipeline.stages.results.report_parts import draw_evaluations

CONFIG = SynthConfig(clips=40, min_seconds=2.0, max_seconds=5.0, actions=("walk", "squat"))
LAYOUT = CONFIG.motion_layout


def truth(number: int) -> Truth:
    sample = make_sample(number, CONFIG)
    body = np.asarray(sample.motion)[:, LAYOUT.part("bodyhand")].astype(np.float32)
    words = sample.texts[0].text
    return Truth(f"clip{number}", body, joints_of(body, LAYOUT), None, words, words, sample.meta.truth)


def test_extremes_take_each_clip_once() -> None:
    assert extremes([3.0, 9.0, 1.0, 5.0, 7.0, 2.0, 8.0]) == [
        ("worst 1", 1), ("worst 2", 6), ("worst 3", 4), ("best 1", 2), ("best 2", 5), ("best 3", 0),
    ]  # fmt: skip
    assert extremes([1.0, 4.0, 2.0]) == [("worst 1", 1), ("worst 2", 2), ("best 1", 0)]
    assert extremes([1.0]) == [("worst 1", 0)] and extremes([]) == []


@pytest.mark.parametrize("joints", [22, 52])
def test_errors_of_joints_by_hand(joints: int) -> None:
    """From the root, fingers from their wrist; a mean over all frames of the clips that have the joint."""
    rng = np.random.default_rng(0)
    clips = [rng.normal(size=(2, frames, joints, 3)) for frames in (3, 8)]
    found = Diagnosis(LAYOUT)
    rows = np.full((2, joints), np.nan)
    for row, (made, real) in zip(rows, clips, strict=True):
        row[:] = joint_distances(made, real)
    rows[1, 22:] = np.nan  # a clip without hands
    found.take_distances(rows, [3, 8])
    wanted = []
    for j in range(joints):
        from_ = next((w for w, hand in zip(WRISTS, FINGERS, strict=True) if j in hand), 0)
        apart = [
            np.linalg.norm((made[t, j] - made[t, from_]) - (real[t, j] - real[t, from_]))
            for made, real in clips[: 2 if j < 22 else 1]
            for t in range(len(made))
        ]
        wanted.append(1000 * float(np.mean(apart)))
    assert list(found.details["joints"].values()) == pytest.approx(wanted, abs=6e-3)
    assert list(found.details["joints"]) == list(LAYOUT.skeleton.joints[:joints])


def test_what_was_noted_is_drawn(tmp_path: Path) -> None:
    """Who walks is shown to somebody who asked for a squat: the page says so, and plays both."""
    by_action = {t.truth["action"]: t for t in map(truth, range(12)) if t.truth}
    truths = [by_action["walk"], by_action["squat"]]
    made = as_shown([Performance(truths[0].joints, t.joints, LAYOUT.fps, truth=t.truth) for t in truths])
    two = confusions([*truths, truths[0]], ["walk", "walk", ""])
    assert two == {"squat": {"walk": 1}, "walk": {"walk": 1}}, "a clip of no single action is left out"
    found = Diagnosis(LAYOUT)
    found.take("generated", truths, [made], [0.25, 1.5])
    found.take("generated", truths, [made], [9.0, 9.0])  # by a second judge
    found.take_distances(np.ones((1, 52)), [4])
    details = json.loads(json.dumps(found.write(tmp_path)))
    assert [(c["place"], c["id"], c["error"]) for c in details["cases"]] == [
        ("worst 1", truths[1].id, 1.5),
        ("best 1", truths[0].id, 0.25),
    ]
    shown = showings(tmp_path, details)
    assert [type(one) for one in shown] == [JointErrors, Confusions, Clips]
    assert isinstance(shown[1], Confusions) and shown[1].counts == two
    (clips,) = (one for one in shown if isinstance(one, Clips))
    for motion, joints in zip(clips.motions[:2], (truths[1].joints, truths[0].joints), strict=True):
        np.testing.assert_allclose(motion.joints, joints, atol=1e-6)
    page = Page("p")
    draw_evaluations(page, shown)
    html = page.html()
    assert html.count('<g class="joint"') == 51 and "worst 1: 1.50 from its words" in html
    squat = re.search(r'<th scope="row">squat</th>(.*?)</tr>', html)
    assert squat is not None and re.findall(r'class="(\w+)" style="--share:(\d+)%', squat[1]) == [
        ("right", "0"),
        ("wrong", "100"),
    ]
    (tmp_path / "cases.safetensors").unlink()
    with pytest.raises(UserError, match=r"cases\.safetensors do not fit .*evaluate again"):
        showings(tmp_path, details)
    assert showings(tmp_path, {}) == []
