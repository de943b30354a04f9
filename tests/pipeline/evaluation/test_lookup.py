"""The row that only looks up its training clips: the nearest caption by words, and by labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from motionloom.datasets.base.records import PRESENT_ALL
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.evaluation import reference_baselines
from motionloom.pipeline.evaluation.clip_metrics import Performance, measure_clip, metrics_of
from motionloom.pipeline.evaluation.reference_baselines import (
    NearestClip,
    by_nearest_caption,
    by_nearest_labels,
)
from motionloom.pipeline.evaluation.truth import has_caption, truth_of


@pytest.fixture(scope="module")
def splits(tmp_path_factory: pytest.TempPathFactory) -> tuple[ShardDataset, ShardDataset]:
    folder = tmp_path_factory.mktemp("lookup") / "shards"
    config = SynthConfig(
        seed=3, clips=40, layout="body133", actions=["kick", "wave"], test_fraction=0.3,
        hold_out=[{"action": "kick", "side": "left"}],
    )  # fmt: skip
    synthesize(config, folder, progress=False)
    return ShardDataset.open(folder, "train"), ShardDataset.open(folder, "test")


def test_a_lookup_finds_training_motion_of_the_action(splits: tuple[ShardDataset, ShardDataset]) -> None:
    train, test = splits
    truths = [truth_of(test, index) for index in range(len(test))]
    held_out = [t.truth["side"] == "left" and t.truth["action"] == "kick" for t in truths if t.truth]
    assert any(held_out) and not all(held_out)
    for lookup in (by_nearest_caption, by_nearest_labels):
        found = lookup(train, truths)
        assert len(found) == len(truths) and {one.id for one in found} <= set(train.ids)
        for one, t in zip(found, truths, strict=True):
            assert one.truth is not None and t.truth is not None
            assert one.truth["action"] == t.truth["action"]
            assert not (one.truth["action"] == "kick" and one.truth["side"] == "left")
        values = [
            measure_clip(
                metrics_of("captions"), Performance(one.joints, t.joints, test.layout.fps, None, t.truth)
            )
            for one, t in zip(found, truths, strict=True)
        ]
        new = [value["agreement.everything"] for value, held in zip(values, held_out, strict=True) if held]
        assert not any(new), "nobody has been trained on held-out combinations"


def test_what_was_trained_on_is_found_itself(splits: tuple[ShardDataset, ShardDataset]) -> None:
    train, _ = splits
    truths = [truth_of(train, index) for index in range(len(train))]
    assert has_caption(train).all()
    for one, t in zip(by_nearest_caption(train, truths), truths, strict=True):
        assert t.caption in [caption.text for caption in train.texts(train.ids.index(one.id))]
    for one, t in zip(by_nearest_labels(train, truths), truths, strict=True):
        assert one.truth == t.truth
    assert by_nearest_labels(train, [replace(truths[0], truth=None)]) == [], (
        "data without truth have no labels"
    )


def test_the_nearest_clip_in_blocks_is_that_of_every_difference(
    splits: tuple[ShardDataset, ShardDataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By float64 differences of all frames; of clips that float32 cannot tell apart the first nearest."""
    train, test = splits
    monkeypatch.setattr(reference_baselines, "_TOGETHER", 3)
    truths = [truth_of(test, index) for index in range(len(test))]
    truths += [truth_of(train, index) for index in range(5)]
    whole = NearestClip(train)
    keys = np.array([np.concatenate(whole._key_of(clip)) for clip in range(len(train))])
    want = [np.square(keys - np.concatenate(whole._key(t.features))).sum(1).argmin() for t in truths]
    close = truths[0].features * np.float32(1 + 3e-7)
    found = whole.find([t.features for t in truths] + [close], [PRESENT_ALL] * (len(truths) + 1))
    assert found == [*want, want[0]] and found[len(test) : -1] == list(range(5))
    assert [len(joints) for _, joints in whole.motions(truths)] == [len(t.features) for t in truths]
