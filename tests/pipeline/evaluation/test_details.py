"""What an evaluation finds beside its tables: errors of joints, confusions, the worst and the best."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import FACE, HANDS, PRESENT_ALL, UserError
from motionloom.datasets.synth.generate import SynthConfig, make_sample
from motionloom.pipeline.contract.showing import JointErrors, Matrix
from motionloom.pipeline.evaluation.confusions import (
    ANOTHER,
    CAPTIONS,
    measured_confusions,
    nearest_captions,
    retrieval_confusions,
)
from motionloom.pipeline.evaluation.details import (
    Case,
    Clips,
    detail_showings,
    extremes,
    joint_map,
    read_cases,
    write_cases,
)
from motionloom.pipeline.evaluation.latent_metrics import Latents, caption_distances
from motionloom.pipeline.evaluation.reconstruction import published_errors
from motionloom.pipeline.evaluation.truth import Truth, digest_of

CONFIG = SynthConfig(clips=40, min_seconds=2.0, max_seconds=5.0)
LAYOUT: MotionLayout = CONFIG.motion_layout


@pytest.fixture(scope="module")
def truths() -> list[Truth]:
    out = []
    for index in range(6):
        sample = make_sample(index, CONFIG)
        body = np.asarray(sample.motion)[:, LAYOUT.part("bodyhand")].astype(np.float32)
        words = sample.texts[0].text
        joints = joints_of(body, LAYOUT)
        out.append(Truth(f"clip{index}", body, joints, None, words, words, sample.meta.truth))
    return out


class Shaky:
    """Stands for a tokenizer: gives back what it gets with noise."""

    layout = LAYOUT
    columns = np.arange(LAYOUT.dim)[LAYOUT.part("bodyhand")]
    stats = SimpleNamespace(mean=np.zeros(LAYOUT.dim))

    def reconstruct(self, motion: Any, present: int = PRESENT_ALL) -> Any:
        noise = np.random.default_rng(len(motion)).normal(scale=0.02, size=motion.shape)
        return (motion + noise).astype(np.float32)


def test_the_mean_over_joints_is_the_published_error(truths: list[Truth]) -> None:
    tokenizer: Any = Shaky()
    found = joint_map(tokenizer, truths)
    sums, frames, clips = 0.0, 0, []
    hands = 0.0
    for truth in truths:
        given = np.zeros((len(truth.features), LAYOUT.dim), np.float32)
        given[:, LAYOUT.part("bodyhand")] = truth.features
        made = joints_of(
            tokenizer.reconstruct(given[:, tokenizer.columns])[:, : truth.features.shape[1]], LAYOUT
        )
        errors = published_errors(torch.from_numpy(made), torch.from_numpy(truth.joints))
        sums, frames = sums + errors[""].mpjpe.item(), frames + len(made)
        hands += errors["_hand"].mpjpe.item()
        clips.append(errors[""].means()["mpjpe"])
    assert len(found.figures["joint_errors_mm"]) == 52
    assert np.mean(found.figures["joint_errors_mm"]) == pytest.approx(sums / frames, abs=0.01)
    # `published_errors` adds both hands up, so each frame counts twice.
    assert np.mean(found.figures["hand_joint_errors_mm"]) == pytest.approx(hands / frames / 2, abs=0.01)
    assert found.clips == pytest.approx(clips, rel=1e-6)
    assert found.figures["joint_errors_mm"][0] == 0.0, "the root is at one place"


def test_clips_without_hands_count_for_the_body_alone(truths: list[Truth]) -> None:
    tokenizer: Any = Shaky()
    bare = [replace(truth, present=PRESENT_ALL & ~HANDS) for truth in truths]
    found = joint_map(tokenizer, bare).figures
    assert found["joint_errors_mm"][22:] == [None] * 30 and "hand_joint_errors_mm" not in found
    assert found["joint_errors_mm"][:22] == joint_map(tokenizer, truths).figures["joint_errors_mm"][:22]
    assert FACE & bare[0].present


def latents(text: Any, made: Any, real: Any) -> Latents:
    return Latents(*(torch.as_tensor(x) for x in (text, real)), [torch.as_tensor(made)], made, made)


def test_the_nearest_caption_by_the_slow_way() -> None:
    generator = np.random.default_rng(0)
    text, motion = generator.normal(size=(2, 12, 5))
    words = [f"caption {k % 8}" for k in range(12)]
    text[8:] = text[:4]  # equal words, equal latents
    found = nearest_captions(torch.from_numpy(text), torch.from_numpy(motion), words)
    for row, taken in enumerate(found):
        cosines = [
            float(motion[row] @ other / np.linalg.norm(motion[row]) / np.linalg.norm(other))
            for other in text[:8]
        ]
        assert taken == int(np.argmax(cosines))


def test_actions_of_synthetic_clips(truths: list[Truth]) -> None:
    names = ["walk", "walk", "jump", "kick", "kick", "kick"]
    said = [
        replace(t, caption=f"{k}", truth={"action": name})
        for k, (t, name) in enumerate(zip(truths, names, strict=True))
    ]
    eye = np.eye(6)
    taken = [0, 2, 2, 1, 4, 4]
    action, real = retrieval_confusions(latents(eye, eye[taken], eye), said)
    assert (action["of"], real["of"]) == ("generated", "real")
    assert action["rows"] == action["columns"] == ["jump", "kick", "walk"]
    assert action["counts"] == [[1, 0, 0], [0, 2, 1], [1, 0, 1]]
    pairs = Counter(zip(names, [names[k] for k in taken], strict=True))
    for own, row in zip(action["rows"], action["counts"], strict=True):
        assert row == [pairs[own, other] for other in action["columns"]]
    assert np.array_equal(np.diag(np.diag(real["counts"])), real["counts"]), "each takes its own"


def test_captions_of_other_clips_that_are_confused_most(truths: list[Truth]) -> None:
    count = 3 * CAPTIONS
    some = [replace(truths[0], caption=f"words {k:02d}", truth=None) for k in range(count)]
    eye = np.eye(count)
    taken = [(k + 1) % count if k % 2 else k for k in range(count)]
    (found,) = retrieval_confusions(latents(eye, eye[taken], eye), some)
    assert (found["of"], found["about"], found["captions"]) == ("generated", "caption", count)
    assert len(found["rows"]) == CAPTIONS
    for own, row in zip(found["rows"], found["counts"], strict=True):
        k = int(own.split()[1])
        expected = f"words {taken[k]:02d}"
        expected = expected if expected in found["rows"] else ANOTHER
        assert sum(row) == 1 and row[found["columns"].index(expected)] == 1
    assert retrieval_confusions(latents(eye, eye, eye), some) == [], "nothing is confused"


def test_what_joints_show_needs_no_network(truths: list[Truth]) -> None:
    joints = [truth.joints for truth in truths]
    (found,) = measured_confusions(truths, joints, LAYOUT.fps)
    assert np.trace(np.array(found["counts"])[:, : len(found["rows"])]) == len(truths), "captions are true"
    (shifted,) = measured_confusions(truths, [*joints[1:], joints[0]], LAYOUT.fps)
    assert np.trace(np.array(shifted["counts"])[:, : len(shifted["rows"])]) < len(truths)
    assert measured_confusions([replace(truths[0], truth=None)], joints[:1], LAYOUT.fps) == []


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
    assert len({digest_of(t) for t in (truths, [other, *truths[1:]], [said, *truths[1:]], truths[:5])}) == 4


def test_cases_come_back_and_are_drawn(truths: list[Truth], tmp_path: Path) -> None:
    cases = [
        Case(of, place, t.id, t.caption, 1.23456, t.joints, t.joints + 0.01)
        for (of, place), t in zip(
            [("reconstruction", "worst 1"), ("generated", "best 1")], truths[:2], strict=True
        )
    ]
    write_cases(tmp_path, cases)
    matrix = {"of": "generated", "by": "retrieval", "captions": 9, "rows": ["wave_hand", "b"]}
    figures = {
        "split": "test",
        "reconstructed_clips": 6,
        "fps": 20.0,
        "skeleton": "smplx52",
        "joint_errors_mm": [1.0] * 52,
        "cases": [case.record() for case in cases],
        "confusions": [
            {**matrix, "about": "action", "columns": ["wave_hand", "b"], "counts": [[1, 0], [0, 2]]}
        ],
    }
    again = read_cases(tmp_path, figures["cases"])
    assert [(c.of, c.place, c.id, c.error) for c in again] == [
        ("reconstruction", "worst 1", "clip0", 1.235),
        ("generated", "best 1", "clip1", 1.235),
    ]
    np.testing.assert_allclose(again[1].made, cases[1].made, atol=1e-6)
    body, hand, first, second = detail_showings(tmp_path, figures)
    assert isinstance(body, JointErrors) and "over 6 test clips" in body.title
    assert isinstance(hand, Matrix) and hand.rows == ["wave hand", "b"]
    assert isinstance(first, Clips) and isinstance(second, Clips)
    assert [m.label for m in second.motions] == ["recorded", "generated"]
    assert {m.group for m in first.motions} == {f"worst 1: {1.235:.3g} mm"}
    assert len(first.motions[0].parents) == len(Skeleton.named("smplx52"))
    with pytest.raises(UserError, match=r"does not fit metrics.json beside it .* evaluate again"):
        read_cases(tmp_path, [*figures["cases"], *figures["cases"]])
    write_cases(tmp_path, [])
    assert read_cases(tmp_path, figures["cases"]) == [] and list(tmp_path.iterdir()) == []
    assert detail_showings(tmp_path, {}) == []
