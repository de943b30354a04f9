"""Hands and faces that a clip does not hold: masked, whatever its file stores there."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from rank_shares import require_rows
from text_samples import OneToken, caption_batches

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import FACE, HANDS
from motionloom.datasets.check.dataset import check
from motionloom.datasets.loading.batches import WindowBatches
from motionloom.datasets.loading.condition_batches import EvalBatches
from motionloom.datasets.loading.mix import MixedDataset
from motionloom.datasets.loading.statistics import STD_FLOOR, FeatureStats, Moments, compute, from_moments
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.shards.options import Reading
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.cache import TextCache

GARBAGE = (0.0, 30.0)


@pytest.fixture(scope="module")
def made() -> ModuleType:
    """Clips of which some lack hands or a face."""
    import held_samples

    return held_samples


@pytest.fixture(scope="module")
def roots(made: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The same data set with zeros and with garbage in the columns that clips do not hold."""
    return [made.write(tmp_path_factory.mktemp("present"), garbage) for garbage in GARBAGE]


@pytest.fixture(scope="module")
def text(roots: list[Path], tmp_path_factory: pytest.TempPathFactory) -> TextCache:
    captions = {c.text for d in openings(roots[0], "mixed") for i in range(len(d)) for c in d.texts(i)}
    return build_with_encoder(
        tmp_path_factory.mktemp("text"), [*captions, "happy"], OneToken(), progress=False
    )


def openings(root: Path, *kinds: str) -> list[ClipDataset]:
    def opened(split: str = "train", **reading: Any) -> ShardDataset:
        return ShardDataset.open(root, split, reading=Reading(**reading))

    known: dict[str, ClipDataset] = {
        "indexed": opened(),
        "streamed": opened(order="streamed", shards_per_group=2),
        "mixed": MixedDataset([(opened(), 1.0), (opened("test"), 2.0)]),
    }
    return [known[kind] for kind in kinds or known]


def test_the_index_says_what_the_metadata_says_and_check_finds_one_that_disagrees(
    roots: list[Path], made: ModuleType, tmp_path: Path
) -> None:
    for dataset in openings(roots[1]):
        assert [dataset.meta(i).present for i in range(len(dataset))] == dataset.present.tolist()
        assert set(dataset.present.tolist()) == {0, 1, 2, 3}
    assert not [problem for problem in check(roots[1]) if "index" in str(problem)]
    root = made.write(tmp_path)
    path = next(root.glob("*train-000000.index"))
    index = json.loads(path.read_bytes())
    index["clips"][2]["held"] ^= HANDS
    path.write_text(json.dumps(index))
    assert any("has_hands or has_face" in str(p) for p in check(root))


def slow_statistics(dataset: ClipDataset) -> tuple[np.ndarray, np.ndarray]:
    """Column by column, over the frames of the clips that hold it."""
    mean, std = np.zeros(dataset.layout.dim), np.ones(dataset.layout.dim)
    for column in range(dataset.layout.dim):
        rows = [
            dataset.motion(i)[:, column].astype(np.float64)
            for i in range(len(dataset))
            if dataset.layout.present_columns[dataset.meta(i).present, column]
        ]
        if rows:
            mean[column], std[column] = np.concatenate(rows).mean(), np.concatenate(rows).std()
    return mean, std


def test_statistics_are_of_the_clips_that_hold_a_column(roots: list[Path]) -> None:
    found = [compute(openings(root, "indexed")[0]) for root in roots]
    mean, std = slow_statistics(openings(roots[1], "indexed")[0])
    np.testing.assert_allclose(found[1].mean, mean, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found[1].std, std, rtol=1e-5)
    for root_stats in zip(*((s.mean, s.std) for s in found), strict=True):
        np.testing.assert_array_equal(*root_stats)
    assert found[0].frames == int(openings(roots[0], "indexed")[0].frames.sum())
    mixed = [compute(openings(root, "mixed")[0], group=True) for root in roots]
    np.testing.assert_array_equal(mixed[0].mean, mixed[1].mean)
    np.testing.assert_array_equal(mixed[0].std, mixed[1].std)


def test_a_part_that_no_clip_holds_has_mean_zero_and_std_one(made: ModuleType, tmp_path: Path) -> None:
    dataset = ShardDataset.open(made.write(tmp_path, 9.0, present=(HANDS, 0)), "train")
    face, group = dataset.layout.part("face"), compute(dataset, group=True)
    for stats in (compute(dataset), group):
        assert (stats.mean[face] == 0).all() and (stats.std[face] == 1).all()
        assert (stats.std[: face[0]] > STD_FLOOR).all() and (stats.std[: face[0]] != 1).all()
    with pytest.raises(UserError, match="split 'train'"):
        WindowBatches(dataset, group, window=8, batch_size=4)
    with pytest.raises(UserError, match="'train' has 1 frames"):
        EvalBatches(dataset, group, batch_size=4, max_frames=16, columns=face)
    WindowBatches(dataset, group, window=8, batch_size=4, columns=dataset.layout.part("bodyhand"))


def test_moments_with_gaps_merge_in_any_grouping() -> None:
    rng = np.random.default_rng(0)
    parts = [(rng.standard_normal((n, 3)) + 5, rng.random(3) < 0.5) for n in (4, 1, 9, 3, 7)]
    left = right = Moments.none(3)
    for rows, present in parts:
        left = left.merge(Moments.of(rows, present))
    for rows, present in reversed(parts):
        right = Moments.of(rows, present).merge(right)
    for column in range(3):
        rows = np.concatenate(
            [rows[:, column] for rows, present in parts if present[column]] or [np.zeros(0)]
        )
        for moments in (left, right):
            assert moments.count[column] == len(rows)
            if len(rows):
                np.testing.assert_allclose(moments.mean[column], rows.mean())
                np.testing.assert_allclose(moments.std[column], rows.std(), atol=1e-12)
    layout = MotionLayout.named("body133")
    assert from_moments(Moments.of(rng.standard_normal((5, 133))), layout).frames == 5


def batches_of(dataset: ClipDataset, stats: FeatureStats, text: TextCache, **kind: Any) -> list[Any]:
    spans: dict[str, Any] = {"max_frames": 20, "min_frames": 4}
    return [
        WindowBatches(dataset, stats, window=16, batch_size=6, seed=1, **kind),
        caption_batches(dataset, stats, text, batch_size=4, seed=1, **spans, **kind),
        EvalBatches(dataset, stats, {"text": text}, captioned="body", batch_size=4, **spans, **kind),
        EvalBatches(dataset, stats, batch_size=4, max_frames=16, **kind),
    ]


@pytest.mark.parametrize("part", ["all", "bodyhand", "hand", "face", "body"])
def test_garbage_changes_no_batch(roots: list[Path], text: TextCache, part: str) -> None:
    stats = compute(openings(roots[0], "indexed")[0])
    layout = stats.layout
    columns = layout.part(part)  # type: ignore[arg-type]
    for clean, dirty in zip(openings(roots[0]), openings(roots[1]), strict=True):
        both = (batches_of(dataset, stats, text, columns=columns) for dataset in (clean, dirty))
        for one, other in zip(*both, strict=True):
            for k in range(min(len(one), 5) if isinstance(one, EvalBatches) else 5):
                a, b = one[k], other[k]
                require_rows(a, [b])
                assert a["present"].shape == (len(a["motion"]), len(columns)) and a["present"].any(1).all()
                assert (a["motion"].masked_select(~a["present"][:, None]) == 0).all()
                assert part not in ("hand", "face") or a["present"].all()
                if "index" in a:
                    want = layout.present_columns[clean.present[a["index"].numpy()]][:, columns]
                    np.testing.assert_array_equal(a["present"].numpy(), want)


def test_clips_without_a_face_are_never_drawn_for_it(roots: list[Path], text: TextCache) -> None:
    stats = compute(openings(roots[0], "indexed")[0])
    for dataset in openings(roots[1]):
        with_face = np.flatnonzero(dataset.present & FACE).tolist()
        assert 0 < len(with_face) < len(dataset)
        face = dataset.layout.part("face")
        windows = WindowBatches(dataset, stats, window=16, batch_size=6, columns=face)
        captions = caption_batches(
            dataset, stats, text, about="face", batch_size=4, max_frames=20, min_frames=4
        )
        held_out = EvalBatches(dataset, stats, {"text": text}, captioned="face", batch_size=4, max_frames=20)
        drawn = {int(i) for k in range(8) for i in windows.clips[windows.plan.batch(k)[1]]}
        assert drawn <= set(with_face) and len(drawn) > len(with_face) / 2
        assert {int(i) for k in range(8) for i in captions[k]["index"]} <= set(with_face)
        assert [int(i) for k in range(len(held_out)) for i in held_out[k]["index"]] == with_face
