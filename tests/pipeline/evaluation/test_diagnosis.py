"""Where a model errs: errors of joints, actions shown for others, the worst and best clips on a page."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.contract.showing import Confusions, JointErrors
from motionloom.pipeline.evaluation.clip_metrics import Performance
from motionloom.pipeline.evaluation.diagnosis import Diagnosis, as_shown, confusions, extremes, showings
from motionloom.pipeline.evaluation.truth import truth_of
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.viewer import Clips
from motionloom.pipeline.stages.results.report_parts import draw_evaluations


def test_extremes_take_each_clip_once() -> None:
    assert extremes([3.0, 9.0, 1.0, 5.0, 7.0, 2.0, 8.0]) == [
        ("worst 1", 1), ("worst 2", 6), ("worst 3", 4), ("best 1", 2), ("best 2", 5), ("best 3", 0),
    ]  # fmt: skip
    assert extremes([1.0, 4.0, 2.0]) == [("worst 1", 1), ("worst 2", 2), ("best 1", 0)]
    assert extremes([1.0]) == [("worst 1", 0)] and extremes([]) == []


def test_what_was_noted_is_drawn(tmp_path: Path) -> None:
    """Who walks is shown to somebody who asked for a squat: the page says so, and plays both."""
    synthesize(SynthConfig(clips=40, actions=["walk", "squat"]), tmp_path / "shards", progress=False)
    data = ShardDataset.open(tmp_path / "shards", "train")
    layout, found = data.layout, Diagnosis(data.layout)
    by_action = {t.truth["action"]: t for k in range(12) if (t := truth_of(data, k)).truth}
    truths = [by_action["walk"], by_action["squat"]]
    made = as_shown([Performance(truths[0].joints, t.joints, layout.fps, truth=t.truth) for t in truths])
    two = confusions([*truths, truths[0]], ["walk", "walk", ""])
    assert two == {"squat": {"walk": 1}, "walk": {"walk": 1}}, "a clip of no single action is left out"
    found.take("generated", truths, [made], [0.25, 1.5])
    found.take("generated", truths, [made], [9.0, 9.0])  # by a second judge
    errors = np.ones((2, 52)) * [[1.0], [3.0]]
    errors[1, 22:] = np.nan  # a clip without hands
    found.take_distances(errors, [10, 30])
    details = json.loads(json.dumps(found.write(tmp_path)))
    assert [(c["place"], c["id"], c["error"]) for c in details["cases"]] == [
        ("worst 1", truths[1].id, 1.5),
        ("best 1", truths[0].id, 0.25),
    ]
    assert list(details["joints"]) == list(layout.skeleton.joints)
    assert [details["joints"][name] for name in ("left_knee", "left_thumb3")] == [2.5, 1.0], "by frames"
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
    assert squat is not None and re.findall(r'class="(\w+)" style="--p:(\d+)%', squat[1]) == [
        ("right", "0"),
        ("wrong", "100"),
    ]
    (tmp_path / "cases.safetensors").unlink()
    with pytest.raises(UserError, match=r"cases\.safetensors do not fit .*evaluate again"):
        showings(tmp_path, details)
    assert showings(tmp_path, {}) == []
