"""The worst and the best of an evaluation: who they are, what the file keeps, what is drawn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.generate import SynthConfig, make_sample
from motionloom.pipeline.evaluation.cases import extreme_cases, extremes, shown_cases, write_cases
from motionloom.pipeline.evaluation.latent_metrics import caption_distances
from motionloom.pipeline.evaluation.truth import Truth, digest_of

CONFIG = SynthConfig(clips=40, min_seconds=2.0, max_seconds=5.0)
LAYOUT = CONFIG.motion_layout


@pytest.fixture(scope="module")
def truths() -> list[Truth]:
    out = []
    for index in range(2):
        sample = make_sample(index, CONFIG)
        body = np.asarray(sample.motion)[:, LAYOUT.part("bodyhand")].astype(np.float32)
        words = sample.texts[0].text
        joints = joints_of(body, LAYOUT)
        out.append(Truth(f"clip{index}", body, joints, None, words, words, sample.meta.truth))
    return out


def test_extremes_take_each_clip_once() -> None:
    assert extremes([3.0, 9.0, 1.0, 5.0, 7.0, 2.0, 8.0]) == [
        ("worst 1", 1), ("worst 2", 6), ("worst 3", 4), ("best 1", 2), ("best 2", 5), ("best 3", 0),
    ]  # fmt: skip
    assert extremes([1.0, 4.0, 2.0]) == [("worst 1", 1), ("best 1", 0)]
    assert extremes([1.0]) == [("worst 1", 0)] and extremes([]) == []


def test_distance_from_the_words_by_hand() -> None:
    text, motion = torch.tensor([[3.0, 0.0], [0.0, 2.0]]), torch.tensor([[1.0, 0.0], [0.0, -5.0]])
    assert caption_distances(text, motion).tolist() == [0.0, 2.0]


def test_the_digest_sees_words_and_motion(truths: list[Truth]) -> None:
    other = replace(truths[0], features=truths[0].features + np.float32(1e-3))
    said = replace(truths[0], caption="something else")
    assert digest_of(truths) == digest_of([replace(t, id="renamed") for t in truths])
    assert len({digest_of(t) for t in (truths, [other, *truths[1:]], [said, *truths[1:]], truths[:1])}) == 4


def test_cases_come_back_and_are_drawn(truths: list[Truth], tmp_path: Path) -> None:
    errors = {"reconstruction": [1.23456, 9.0], "generated": [0.5, 0.25]}
    cases = [
        case
        for of, found in errors.items()
        for case in extreme_cases(of, truths, found, lambda k: truths[k].joints + 0.01)
    ]
    details = write_cases(tmp_path, cases, LAYOUT)
    assert [(c["of"], c["place"], c["id"], c["error"]) for c in details["cases"]] == [
        ("reconstruction", "worst 1", "clip1", 9.0),
        ("reconstruction", "best 1", "clip0", 1.235),
        ("generated", "worst 1", "clip0", 0.5),
        ("generated", "best 1", "clip1", 0.25),
    ]
    kept, made = shown_cases(tmp_path, details)
    assert [m.label for m in made.motions[:2]] == ["recorded", "generated"]
    np.testing.assert_allclose(kept.motions[3].joints, cases[1].made, atol=1e-6)
    assert [m.group for m in kept.motions[::2]] == ["worst 1: 9 mm", "best 1: 1.24 mm"]
    assert len(kept.motions[0].parents) == LAYOUT.num_joints
    with pytest.raises(UserError, match=r"cases\.safetensors.*metrics\.json"):
        shown_cases(tmp_path, details | {"cases": [*details["cases"], *details["cases"]]})
    assert write_cases(tmp_path, [], LAYOUT) == {} and list(tmp_path.iterdir()) == []
    assert shown_cases(tmp_path, details) == [] == shown_cases(tmp_path, {})
