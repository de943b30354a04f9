"""Batches: whole local batches, pure functions of (seed, step), the same for any number of ranks."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from rank_shares import require_shares
from text_samples import WordLengths, caption_batches
from torch.utils.data import DataLoader

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Caption
from motionloom.datasets.loading.batches import WindowBatches
from motionloom.datasets.loading.condition_batches import ConditionBatch, ConditionBatches, EvalBatches
from motionloom.datasets.loading.crops import frame_span
from motionloom.datasets.loading.plan import Share
from motionloom.datasets.loading.statistics import FeatureStats, compute
from motionloom.datasets.loading.steps import Steps
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.cache import TextCache
from motionloom.datasets.text.encoder import EncodedText


@pytest.fixture(scope="module")
def train(made: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> ShardDataset:
    root = tmp_path_factory.mktemp("data")
    made.write(root, count=100)
    return ShardDataset.open(root, "train")


@pytest.fixture(scope="module")
def stats(train: ShardDataset) -> FeatureStats:
    return compute(train)


@pytest.fixture(scope="module")
def text(train: ShardDataset, tmp_path_factory: pytest.TempPathFactory) -> TextCache:
    captions = [caption.text for i in range(len(train)) for caption in train.texts(i) + train.face_texts(i)]
    return build_with_encoder(tmp_path_factory.mktemp("text"), captions, WordLengths(), progress=False)


def place_of(part: np.ndarray, clip: np.ndarray) -> int:
    """The one frame of a clip at which a part of it begins."""
    every = range(len(clip) - len(part) + 1)
    (first,) = [s for s in every if np.allclose(clip[s : s + len(part)], part, atol=1e-5)]
    return first


def test_windows_are_pieces_of_clips(train: ShardDataset, stats: FeatureStats) -> None:
    batches = WindowBatches(train, stats, window=32, batch_size=24, seed=3)
    normal = [stats.normalize(train.motion(i)) for i in range(len(train))]
    starts = set()
    for k in range(12):
        batch = batches[k]
        assert batch["motion"].shape == (24, 32, 133) and batch["motion"].dtype == torch.float32
        assert batch["length"].dtype == torch.int64
        _, clips = batches.plan.batch(k)
        for row in range(24):
            motion, length = batch["motion"][row].numpy(), int(batch["length"][row])
            clip = normal[clips[row]]
            assert length == min(len(clip), 32)
            starts.add(place_of(motion[:length], clip) / max(1, len(clip) - length))
            assert (motion[length:] == 0).all()
    assert min(starts) == 0 and max(starts) == 1, "first and last window of a clip must be reachable"
    assert len(starts) > 50


@pytest.mark.parametrize("columns", [range(133), range(4, 90), [0, 3, 4, 5, 60, 132]])
def test_windows_are_normalised_to_the_byte(
    train: ShardDataset, stats: FeatureStats, columns: Sequence[int]
) -> None:
    chosen = np.array(columns)
    batches = WindowBatches(train, stats, window=32, batch_size=8, seed=3, columns=chosen)
    worker = pickle.loads(pickle.dumps(batches))  # which keeps no clips
    for k in range(4):
        clips, starts, lengths = batches._windows(k)
        wanted = np.zeros((8, 32, len(chosen)), dtype=np.float32)
        for row, (clip, start, length) in enumerate(zip(clips, starts, lengths, strict=True)):
            part = train.motion(int(clip))[start : start + length, chosen]
            wanted[row, :length] = (part - stats.mean[chosen]) * (1.0 / stats.std[chosen])
        for made in (batches, worker):
            np.testing.assert_array_equal(made[k]["motion"].numpy(), wanted)


@pytest.mark.parametrize("world", [2, 3, 6])
def test_any_number_of_ranks_sees_the_same_global_batch(
    train: ShardDataset, stats: FeatureStats, text: TextCache, world: int
) -> None:
    def captions(share: Share) -> ConditionBatches:
        return caption_batches(
            train, stats, text, batch_size=12, max_frames=40, min_frames=8, seed=1, share=share
        )

    require_shares(captions, worlds=[world])


def test_loader_workers_change_nothing_and_a_run_resumes_anywhere(
    train: ShardDataset, stats: FeatureStats
) -> None:
    batches = WindowBatches(train, stats, window=16, batch_size=8, seed=1)
    want = [batches[k]["motion"] for k in range(6)]
    for workers, start in ((0, 0), (0, 3), (2, 2)):
        steps = Steps(lambda rank, world: batches, 6, start)
        context = "spawn" if workers else None
        loader = DataLoader(steps, batch_size=None, num_workers=workers, multiprocessing_context=context)
        got = [batch["motion"] for batch in loader]
        assert len(got) == 6 - start
        for one, other in zip(got, want[start:], strict=True):
            assert torch.equal(one, other)


def test_caption_batches(train: ShardDataset, stats: FeatureStats, text: TextCache) -> None:
    batches = caption_batches(train, stats, text, batch_size=16, max_frames=40, min_frames=8, seed=5)
    spans_seen: set[tuple[int, str]] = set()
    held = []  # views, whose memory no later batch may take
    for k in range(20):
        batch = batches[k]
        held += [(batch["motion"][k % 16], batch["motion"][k % 16].clone())] if k % 3 else []
        length = batch["length"].numpy()
        assert batch["motion"].shape[1] % 4 == 0
        assert 0 <= batch["motion"].shape[1] - length.max() < 4
        for row, (clip, caption) in enumerate(zip(batch["index"].tolist(), batch["caption"], strict=True)):
            found = {item.text: item for item in train.texts(clip)}[caption]
            first, end = frame_span(found, train.layout.fps, int(train.frames[clip]))
            assert length[row] == min(end - first, 40)
            normal = stats.normalize(train.motion(clip)[first:end])
            motion = batch["motion"][row].numpy()
            place_of(motion[: length[row]], normal)
            assert (motion[length[row] :] == 0).all()
            spans_seen.add((clip, caption))
            words = [len(word) for word in caption.split()]
            text = batch["conditions"]["text"]
            assert text.features[row, :, 0][text.mask[row]].tolist() == words
            assert (text.features[row][~text.mask[row]] == 0).all()
        assert text.pooled is not None and text.pooled.shape == (16, 4) and text.mask.dtype == torch.bool
        assert batch["conditions"]["text"].features.dtype == torch.float32
    assert all(torch.equal(view, copy) for view, copy in held)
    both = [clip for clip in range(len(train)) if len({c for i, c in spans_seen if i == clip}) == 2]
    assert len(both) > 10, "both captions of a clip must be drawn in time"


def test_short_stretches_give_way_to_long_ones(
    train: ShardDataset, stats: FeatureStats, text: TextCache
) -> None:
    batches = caption_batches(train, stats, text, batch_size=16, max_frames=60, min_frames=20, seed=5)
    for k in range(5):
        batch = batches[k]
        assert all("walks" in caption for caption in batch["caption"]), "the other stretch has ten frames"
        assert (batch["length"] >= 20).all()


def test_face_batches_take_face_captions_and_columns(
    train: ShardDataset, stats: FeatureStats, text: TextCache
) -> None:
    with_face = set(np.flatnonzero(train.has("face_texts.json")).tolist())
    assert 0 < len(with_face) < len(train)
    columns = np.arange(10, 20)
    batches = caption_batches(
        train, stats, text, about="face", batch_size=8, max_frames=40, min_frames=8, columns=columns
    )
    for k in range(8):
        batch = batches[k]
        assert set(batch["caption"]) == {"happy"} and set(batch["index"].tolist()) <= with_face
        assert batch["motion"].shape[2] == 10
    with pytest.raises(UserError, match="'face'"):
        caption_batches(train, stats, text, about="face", batch_size=8, max_frames=40, min_frames=8)


def test_evaluation_sees_every_clip_once_in_order(
    train: ShardDataset, stats: FeatureStats, text: TextCache
) -> None:
    clips: list[int] = []
    batches = EvalBatches(
        train, stats, {"text": text}, captioned="body", batch_size=16, max_frames=40, min_frames=25
    )
    for k in range(len(batches)):
        part = batches[k]
        clips += part["index"].tolist()
        for row, clip in enumerate(part["index"].tolist()):
            assert part["caption"][row] == train.texts(clip)[0].text
            length = int(part["length"][row])
            assert length == min(40, train.frames[clip])
            wanted = stats.normalize(train.motion(clip)[:length])
            np.testing.assert_allclose(part["motion"][row, :length].numpy(), wanted, atol=1e-5)
    assert clips == np.flatnonzero(train.frames >= 25).tolist()
    without = EvalBatches(train, stats, batch_size=16, max_frames=40)
    assert sum(len(without[k]["index"]) for k in range(len(without))) == len(train)
    assert "sentence" not in without[0]
    with pytest.raises(IndexError):
        without[len(without)]


class Likeness(WordLengths):
    """Another encoder, of another width."""

    name = "likeness"
    dim = 3

    def encode(self, captions: Sequence[str]) -> EncodedText:
        sentence = np.eye(3, dtype=np.float32)[[len(caption) % 3 for caption in captions]]
        return EncodedText(sentence, sentence[:, None], np.ones((len(captions), 1), dtype=bool))


def test_batches_hold_the_embeddings_that_say_what_is_alike(
    train: ShardDataset, stats: FeatureStats, text: TextCache, tmp_path: Path
) -> None:
    def batch_of(cache: TextCache) -> ConditionBatch:
        return caption_batches(train, stats, cache, batch_size=8, max_frames=40, min_frames=8)[0]

    plain = batch_of(text)
    assert torch.equal(plain["similarity"], plain["conditions"]["text"].pooled), "one encoder for both"
    captions = list(text.captions_by_key().values())
    build_with_encoder(tmp_path / "similarity", captions, Likeness(), progress=False)
    batch = batch_of(build_with_encoder(tmp_path, captions, WordLengths(), progress=False))
    assert torch.equal(batch["conditions"]["text"].pooled, plain["conditions"]["text"].pooled)
    wanted = np.eye(3)[[len(caption) % 3 for caption in batch["caption"]]]
    np.testing.assert_array_equal(batch["similarity"].numpy(), wanted)


def test_caption_stretches_in_frames() -> None:
    def span(start: float, end: float | None) -> tuple[int, int]:
        return frame_span(Caption(text="", start=start, end=end), 20.0, 100)

    assert span(0, None) == (0, 100)
    assert span(1, 3) == (20, 60)
    assert span(1, None) == (20, 100)
    assert span(4, 99) == (80, 100)
    assert span(0, 0) == (0, 100), "an empty stretch means the whole clip"
    assert span(7, 9) == (0, 100), "so does one outside the clip"


def test_mistakes_are_named(train: ShardDataset, stats: FeatureStats, text: TextCache) -> None:
    with pytest.raises(UserError, match="3 ranks"):
        WindowBatches(train, stats, window=16, batch_size=8, share=Share(0, 3))
    with pytest.raises(UserError, match="lower min_frames"):
        caption_batches(train, stats, text, batch_size=8, max_frames=2000, min_frames=1000)
    with pytest.raises(UserError, match="need 1 <= min_frames"):
        caption_batches(train, stats, text, batch_size=8, max_frames=20, min_frames=30)
    other = MotionLayout.named("body133", fps=30.0)
    with pytest.raises(UserError, match=r"body133 .exact, 30 fps"):
        WindowBatches(train, FeatureStats(stats.mean, stats.std, other), window=16, batch_size=8)
