"""Batches with conditions: shares by kind, masks of what is missing, music cut with the motion, any ranks."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pydantic import Field
from rank_shares import require_shares
from text_samples import WordLengths

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Caption
from motionloom.datasets.loading.condition_batches import ConditionBatch, ConditionBatches
from motionloom.datasets.loading.kinds import Balance, Drop, all_kinds, key_of
from motionloom.datasets.loading.mix import MixedDataset
from motionloom.datasets.loading.plan import Share
from motionloom.datasets.loading.statistics import FeatureStats, compute, frame_statistics
from motionloom.datasets.modalities.audio import RECORD as AUDIO
from motionloom.datasets.modalities.modality import FrameStats
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import write_dataset
from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.cache import TextCache

LAYOUT = MotionLayout.named("body133")
KINDS = [key_of(kind) for kind in all_kinds(["text", "audio"])]
WIDTH = 6
"""Audio features a frame; the loader takes any number."""


class Shares(Config):
    """As the stage's config has them."""

    balance: Balance = Field(default_factory=dict)
    drop: Drop = Field(default_factory=dict)


def clip(i: int, every: int = 1, rate: int = 1) -> Sample:
    """Clip i is of kind `KINDS[i % 4]`; its music says clip and frame in its columns."""
    rng = np.random.default_rng(i)
    frames = 40 + 7 * (i % 9)
    motion = rng.standard_normal((frames, LAYOUT.dim)).astype(np.float32)
    audio = rng.standard_normal((frames * rate, WIDTH)).astype(np.float32)
    audio[:, 0], audio[:, 1], audio[:, 2] = i, np.arange(frames * rate), 1.0
    kind = KINDS[(i * every) % 4]
    meta = LAYOUT.clip_meta(f"c{i}", source="made", split="train", frames=frames, licence="CC0")
    texts = [Caption(text=f"person number {i} dances"), Caption(text=f"short {i}", start=0.5, end=1.5)]
    return Sample(
        meta,
        motion,
        texts=texts if kind in ("text", "text+audio") else [],
        audio=audio if kind in ("audio", "text+audio") else None,
    )


def written(root: Path, count: int = 60, every: int = 1, rate: int = 1) -> ShardDataset:
    options = {"count": count, "every": every, "rate": rate}
    about = {"name": "made", "licence": "CC0", "converter": "test", "converter_version": 1}
    facts = DatasetFacts(layout=LAYOUT, options=options, **about)
    rows, make = [("train", i) for i in range(count)], partial(clip, every=every, rate=rate)
    write_dataset(root, rows, make, facts, WriteOptions(clips_per_shard=16, progress=False))
    return ShardDataset.open(root, "train")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> ShardDataset:
    return written(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def stats(data: ShardDataset) -> FeatureStats:
    return compute(data)


@pytest.fixture(scope="module")
def heard(data: ShardDataset) -> FrameStats:
    return frame_statistics(data, AUDIO)


@pytest.fixture(scope="module")
def text(data: ShardDataset, tmp_path_factory: pytest.TempPathFactory) -> TextCache:
    captions = [caption.text for i in range(60) for caption in clip(i, every=0).texts]
    return build_with_encoder(tmp_path_factory.mktemp("text"), captions, WordLengths(), progress=False)


@pytest.fixture(scope="module")
def readers(heard: FrameStats, text: TextCache) -> dict[str, object]:
    return {"text": text, "audio": heard}


def kind_of(data: ShardDataset, i: int) -> str:
    return KINDS[int(data.ids[i][1:]) % 4]


def kinds_in(batch: ConditionBatch) -> list[str]:
    text, audio = (batch["conditions"][name].present for name in ("text", "audio"))
    rows = zip(text.tolist(), audio.tolist(), strict=True)
    return ["+".join(["text"] * t + ["audio"] * a) or "none" for t, a in rows]


def test_rows_hold_what_their_clips_come_with(
    data: ShardDataset, stats: FeatureStats, readers: dict[str, object], heard: FrameStats, text: TextCache
) -> None:
    batches = ConditionBatches(data, stats, readers, batch_size=20, max_frames=24, min_frames=16)
    seen: Counter[str] = Counter()
    starts: set[int] = set()
    for k in range(6):
        batch = batches[k]
        words, sound = batch["conditions"]["text"], batch["conditions"]["audio"]
        assert words.pooled is not None
        assert sound.pooled is None
        assert batch["motion"].shape[:2] == sound.features.shape[:2] == sound.mask.shape
        for row, index in enumerate(batch["index"].tolist()):
            kind, length = kind_of(data, index), int(batch["length"][row])
            seen[kind] += 1
            assert kinds_in(batch)[row] == kind
            motion = stats.normalize(data.motion(index))
            first = next(
                s
                for s in range(len(motion) - length + 1)
                if np.allclose(motion[s : s + length], batch["motion"][row, :length].numpy(), atol=1e-5)
            )
            starts.add(first)
            if kind in ("audio", "text+audio"):
                rows = data.array(index, "audio.npy")
                assert rows is not None
                wanted = ((rows.astype(np.float64) - heard.mean) / heard.std)[first : first + length]
                assert np.abs(sound.features[row, :length].numpy() - wanted).max() < 1e-4
                assert sound.mask[row].tolist() == [t < length for t in range(sound.mask.shape[1])]
            else:
                assert not sound.features[row].any()
            if kind in ("text", "text+audio"):
                caption = batch["caption"][row]
                tokens, mask = text.tokens([caption])
                assert int(words.mask[row].sum()) == int(mask.sum())
                assert np.array_equal(words.features[row, : mask.shape[1]].numpy(), tokens[0])
                assert np.allclose(words.pooled[row].numpy(), text.sentence([caption])[0])
            else:
                assert batch["caption"][row] == ""
                assert not words.features[row].any() and not words.pooled[row].any()
    assert set(seen) == set(KINDS)
    assert len(starts) > 5


def test_a_balance_gives_exact_shares(
    data: ShardDataset, stats: FeatureStats, readers: dict[str, object]
) -> None:
    balance = {"text": 1, "audio": 2, "text+audio": 2}
    batches = ConditionBatches(data, stats, readers, batch_size=10, max_frames=16, balance=balance)
    counts = [Counter(kinds_in(batches[k])) for k in range(8)]
    # 15 clips of each of three kinds: an epoch is 45 places in whole batches, 40.
    for epoch in (counts[:4], counts[4:]):
        assert sum(epoch, Counter()) == {"text": 8, "audio": 16, "text+audio": 16}
    assert all(abs(count["text"] - 2) <= 1 and abs(count["audio"] - 4) <= 1 for count in counts)
    # All clips of a kind come before one comes again.
    order = [i for k in range(8) for i in batches[k]["index"].tolist() if kind_of(data, i) == "audio"]
    assert len(set(order[:15])) == 15


def test_batches_of_one_kind(data: ShardDataset, stats: FeatureStats, readers: dict[str, object]) -> None:
    batches = ConditionBatches(
        data, stats, readers, batch_size=5, max_frames=16, homogeneous=True,
        balance={"text": 1, "audio": 1, "none": 1},
    )  # fmt: skip
    kinds = []
    for k in range(18):
        found = set(kinds_in(batches[k]))
        assert len(found) == 1
        kinds += found
    assert Counter(kinds[:9]) == Counter(kinds[9:]) == {"text": 3, "audio": 3, "none": 3}
    audio = [batches[k]["index"].tolist() for k in range(9) if kinds[k] == "audio"]
    assert len({i for batch in audio for i in batch}) == 15


@pytest.mark.parametrize("homogeneous", [False, True])
def test_any_number_of_ranks_sees_the_same_rows(
    data: ShardDataset, stats: FeatureStats, readers: dict[str, object], homogeneous: bool
) -> None:
    def build(share: Share) -> ConditionBatches:
        return ConditionBatches(
            data, stats, readers, batch_size=12, max_frames=20, seed=4, share=share,
            balance={"text": 1, "audio": 1, "text+audio": 1, "none": 1}, drop={"text": 0.4, "audio": 0.4},
            homogeneous=homogeneous,
        )  # fmt: skip

    require_shares(build, (0, 3, 7))


def test_drop_leaves_one_of_two(data: ShardDataset, stats: FeatureStats, readers: dict[str, object]) -> None:
    batches = ConditionBatches(
        data, stats, readers, batch_size=15, max_frames=16, balance={"text+audio": 1},
        drop={"text": 0.25, "audio": 0.5},
    )  # fmt: skip
    found = Counter(kind for k in range(40) for kind in kinds_in(batches[k]))
    assert set(found) == {"text+audio", "audio", "text"}
    for kind, share in {"text+audio": 0.25, "audio": 0.25, "text": 0.5}.items():
        # Six standard deviations of 600 draws.
        assert abs(found[kind] / 600 - share) < 6 * np.sqrt(share * (1 - share) / 600)


def test_a_mix_keeps_its_weights_within_a_kind(
    stats: FeatureStats, readers: dict[str, object], data: ShardDataset, tmp_path: Path
) -> None:
    mixed = MixedDataset([(data, 1.0), (written(tmp_path / "second", count=20), 3.0)])
    batches = ConditionBatches(
        mixed, stats, readers, batch_size=8, max_frames=16, balance={"text": 1, "audio": 1}
    )
    batch_of = [batches[k] for k in range(5)]
    assert sum((Counter(kinds_in(batch)) for batch in batch_of), Counter()) == {"audio": 20, "text": 20}
    first = sum(int((batch["index"] < len(data)).sum()) for batch in batch_of)
    assert first == 10


def test_audio_statistics_are_those_of_all_rows_at_once(
    data: ShardDataset, heard: FrameStats, tmp_path: Path
) -> None:
    rows = np.concatenate(
        [a for i in range(len(data)) if (a := data.array(i, "audio.npy")) is not None]
    ).astype(np.float64)
    assert heard.frames == len(rows)
    assert np.allclose(heard.mean, rows.mean(0), rtol=1e-6, atol=1e-6)
    std = rows.std(0)
    assert std[2] == 0
    std[2] = 1.0
    assert np.allclose(heard.std, std, rtol=1e-6)
    heard.save(tmp_path / "audio.safetensors")
    again = FrameStats.load(tmp_path / "audio.safetensors")
    assert np.array_equal([again.mean, again.std], [heard.mean, heard.std]) and again.frames == heard.frames
    (tmp_path / "broken").write_bytes(b"no")
    with pytest.raises(UserError, match="broken"):
        FrameStats.load(tmp_path / "broken")


def test_mistakes_are_named(
    data: ShardDataset, stats: FeatureStats, readers: dict[str, object], tmp_path: Path
) -> None:
    words = written(tmp_path / "words", count=12, every=0)
    with pytest.raises(UserError, match=r"audio features"):
        frame_statistics(words, AUDIO)
    with pytest.raises(UserError, match=r"balance.audio"):
        ConditionBatches(words, stats, readers, batch_size=4, max_frames=16, balance={"audio": 1})
    with pytest.raises(UserError, match="3 ranks"):
        ConditionBatches(data, stats, readers, batch_size=4, max_frames=16, share=Share(0, 3))
    for wrong in (
        {"balance": {}},
        {"balance": {"text": 0}},
        {"balance": {"text+smell": 1}},
        {"balance": {"text": -1}},
        {"drop": {"text": 0.7, "audio": 0.7}},
    ):
        with pytest.raises(UserError, match=next(iter(wrong))):
            Shares.parse(wrong, "utt")
    parsed = Shares.parse({"balance": {"audio + text": 1, "text": 2}}, "utt")
    assert list(parsed.balance) == ["text", "text+audio"]
    double = written(tmp_path / "double", count=4, rate=2)
    batches = ConditionBatches(double, stats, readers, batch_size=4, max_frames=16)
    with pytest.raises(UserError, match="one row"):
        batches[0]
