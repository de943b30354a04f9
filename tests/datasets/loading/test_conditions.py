"""Batches with conditions: shares by kind, masks of what is missing, music cut with the motion, any ranks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from motionloom.datasets.loading.audio_statistics import AudioStats, compute_audio
from motionloom.datasets.loading.batches import CaptionBatches
from motionloom.datasets.loading.condition_batches import (
    ConditionBatch,
    ConditionBatches,
    EvalConditionBatches,
)
from motionloom.datasets.loading.mix import MixedDataset
from motionloom.datasets.loading.modalities import KINDS, Balance, Drop
from motionloom.datasets.loading.statistics import FeatureStats, compute
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Caption, UserError
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import write_dataset
from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.cache import TextCache
from motionloom.datasets.text.encoder import EncodedText

LAYOUT = MotionLayout.named("body133")
WIDTH = 6
"""Audio features a frame; the loader takes any number."""


class WordLengths:
    """One token per word, all its values the word's length."""

    name, dim = "word-lengths", 4

    def encode(self, captions: Sequence[str]) -> EncodedText:
        words = [caption.split() for caption in captions]
        tokens = np.zeros((len(words), max(map(len, words)), 4), dtype=np.float32)
        mask = np.zeros(tokens.shape[:2], dtype=bool)
        for i, row in enumerate(words):
            tokens[i, : len(row)] = np.array([len(word) for word in row])[:, None]
            mask[i, : len(row)] = True
        return EncodedText(np.full((len(words), 4), 0.5, dtype=np.float32), tokens, mask)


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
        texts=texts if kind in ("text", "both") else [],
        audio=audio if kind in ("audio", "both") else None,
    )


def written(root: Path, count: int = 60, every: int = 1, rate: int = 1) -> ShardDataset:
    write_dataset(
        root,
        [("train", i) for i in range(count)],
        partial(clip, every=every, rate=rate),
        DatasetFacts(
            name="made",
            layout=LAYOUT,
            licence="CC0",
            converter="test",
            converter_version=1,
            options={"count": count, "every": every, "rate": rate},
        ),
        WriteOptions(clips_per_shard=16, progress=False),
    )
    return ShardDataset.open(root, "train")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> ShardDataset:
    return written(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def stats(data: ShardDataset) -> FeatureStats:
    return compute(data)


@pytest.fixture(scope="module")
def heard(data: ShardDataset) -> AudioStats:
    return compute_audio(data)


@pytest.fixture(scope="module")
def text(data: ShardDataset, tmp_path_factory: pytest.TempPathFactory) -> TextCache:
    captions = [caption.text for i in range(60) for caption in clip(i, every=0).texts]
    return build_with_encoder(tmp_path_factory.mktemp("text"), captions, WordLengths(), progress=False)


def kind_of(data: ShardDataset, i: int) -> str:
    return KINDS[int(data.ids[i][1:]) % 4]


def kinds_in(batch: ConditionBatch) -> list[str]:
    text, audio = (batch["conditions"][name].present for name in ("text", "audio"))
    names = {(True, True): "both", (True, False): "text", (False, True): "audio", (False, False): "none"}
    return [names[bool(t), bool(a)] for t, a in zip(text, audio, strict=True)]


def test_rows_hold_what_their_clips_come_with(
    data: ShardDataset, stats: FeatureStats, heard: AudioStats, text: TextCache
) -> None:
    batches = ConditionBatches(data, stats, text, heard, batch_size=20, max_frames=24, min_frames=16)
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
            if kind in ("audio", "both"):
                rows = data.audio(index)
                assert rows is not None
                wanted = ((rows.astype(np.float64) - heard.mean) / heard.std)[first : first + length]
                assert np.abs(sound.features[row, :length].numpy() - wanted).max() < 1e-4
                assert sound.mask[row].tolist() == [t < length for t in range(sound.mask.shape[1])]
            else:
                assert not sound.features[row].any()
            if kind in ("text", "both"):
                caption = batch["caption"][row]
                tokens, mask = text.tokens([caption])
                assert int(words.mask[row].sum()) == int(mask.sum())
                assert np.array_equal(words.features[row, : mask.shape[1]].numpy(), tokens[0])
                assert np.allclose(words.pooled[row].numpy(), text.sentence([caption])[0])
            else:
                assert batch["caption"][row] == ""
                assert not words.features[row].any()
                assert not words.pooled[row].any()
    assert set(seen) == set(KINDS)
    assert len(starts) > 5


def test_a_balance_gives_exact_shares(
    data: ShardDataset, stats: FeatureStats, heard: AudioStats, text: TextCache
) -> None:
    balance = Balance(text=1, audio=2, both=2)
    batches = ConditionBatches(data, stats, text, heard, batch_size=10, max_frames=16, balance=balance)
    counts = [Counter(kinds_in(batches[k])) for k in range(8)]
    # 15 clips of each of three kinds: an epoch is 45 places in whole batches, 40.
    assert sum(counts[:4], Counter()) == {"text": 8, "audio": 16, "both": 16}
    assert sum(counts[4:], Counter()) == {"text": 8, "audio": 16, "both": 16}
    for count in counts:
        assert abs(count["text"] - 2) <= 1
        assert abs(count["audio"] - 4) <= 1
    # All clips of a kind come before one comes again.
    order = [i for k in range(8) for i in batches[k]["index"].tolist() if kind_of(data, i) == "audio"]
    assert len(set(order[:15])) == 15


def test_batches_of_one_kind(
    data: ShardDataset, stats: FeatureStats, heard: AudioStats, text: TextCache
) -> None:
    batches = ConditionBatches(
        data, stats, text, heard, batch_size=5, max_frames=16, homogeneous=True,
        balance=Balance(text=1, audio=1, none=1),
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
    data: ShardDataset, stats: FeatureStats, heard: AudioStats, text: TextCache, homogeneous: bool
) -> None:
    def build(rank: int, world: int) -> ConditionBatches:
        return ConditionBatches(
            data, stats, text, heard, batch_size=12, max_frames=20, seed=4, rank=rank, world=world,
            balance=Balance(text=1, audio=1, both=1, none=1), drop=Drop(text=0.4, audio=0.4),
            homogeneous=homogeneous,
        )  # fmt: skip

    whole = build(0, 1)
    for k in (0, 3, 7):
        one = whole[k]
        for world in (2, 3):
            ranks = [build(rank, world)[k] for rank in range(world)]
            assert one["index"].tolist() == [i for batch in ranks for i in batch["index"].tolist()]
            assert one["caption"] == [c for batch in ranks for c in batch["caption"]]
            assert kinds_in(one) == [kind for batch in ranks for kind in kinds_in(batch)]
            assert one["length"].tolist() == [n for batch in ranks for n in batch["length"].tolist()]
            row = 0
            for batch in ranks:
                own = batch["conditions"]["audio"].features
                sound = one["conditions"]["audio"].features[row : row + len(own), : own.shape[1]]
                assert torch.equal(sound, own)
                row += len(own)


def test_drop_leaves_one_of_both(
    data: ShardDataset, stats: FeatureStats, heard: AudioStats, text: TextCache
) -> None:
    batches = ConditionBatches(
        data, stats, text, heard, batch_size=15, max_frames=16, balance=Balance(both=1),
        drop=Drop(text=0.25, audio=0.5),
    )  # fmt: skip
    found = Counter(kind for k in range(40) for kind in kinds_in(batches[k]))
    assert set(found) == {"both", "audio", "text"}
    for kind, share in {"both": 0.25, "audio": 0.25, "text": 0.5}.items():
        # Six standard deviations of 600 draws.
        assert abs(found[kind] / 600 - share) < 6 * np.sqrt(share * (1 - share) / 600)


def test_captions_alone_give_the_batches_of_caption_batches(
    stats: FeatureStats, text: TextCache, tmp_path: Path
) -> None:
    data = written(tmp_path / "text", count=40, every=0)
    old = CaptionBatches(data, stats, text, batch_size=8, max_frames=24, min_frames=10, seed=5)
    new = ConditionBatches(data, stats, text, None, batch_size=8, max_frames=24, min_frames=10, seed=5)
    for k in (0, 2, 11):
        one, other = old[k], new[k]
        for name in ("motion", "length", "present", "index"):
            assert torch.equal(one[name], other[name])  # type: ignore[literal-required]
        assert one["caption"] == other["caption"]
        condition = other["conditions"]["text"]
        assert condition.pooled is not None
        assert all(map(torch.equal, one["conditions"]["text"], condition))
        assert "audio" not in other["conditions"]


def test_a_mix_keeps_its_weights_within_a_kind(
    stats: FeatureStats, heard: AudioStats, text: TextCache, data: ShardDataset, tmp_path: Path
) -> None:
    mixed = MixedDataset([(data, 1.0), (written(tmp_path / "second", count=20), 3.0)])
    batches = ConditionBatches(
        mixed, stats, text, heard, batch_size=8, max_frames=16, balance=Balance(audio=1, text=1)
    )
    batch_of = [batches[k] for k in range(5)]
    assert sum((Counter(kinds_in(batch)) for batch in batch_of), Counter()) == {"audio": 20, "text": 20}
    first = sum(int((batch["index"] < len(data)).sum()) for batch in batch_of)
    assert first == 10


def test_evaluation_sees_the_clips_of_a_kind_once(
    data: ShardDataset, stats: FeatureStats, heard: AudioStats, text: TextCache
) -> None:
    seen: list[int] = []
    for rank in range(2):
        batches = EvalConditionBatches(
            data, stats, text, heard, batch_size=8, max_frames=30, kinds=("audio", "both"), rank=rank, world=2
        )
        for k in range(len(batches)):
            batch = batches[k]
            seen += batch["index"][batch["valid"]].tolist()
            assert set(kinds_in(batch)) <= {"audio", "both"}
    wanted = [i for i in range(len(data)) if kind_of(data, i) in ("audio", "both")]
    assert sorted(seen) == wanted


def test_workers_and_pinning_change_nothing(
    data: ShardDataset, stats: FeatureStats, heard: AudioStats, text: TextCache
) -> None:
    batches = ConditionBatches(data, stats, text, heard, batch_size=8, max_frames=24)
    loader = DataLoader(batches, batch_size=None, sampler=range(2, 5), num_workers=2)
    for k, batch in enumerate(loader, start=2):
        assert torch.equal(batch["motion"], batches[k]["motion"])
        for name, condition in batches[k]["conditions"].items():
            assert torch.equal(batch["conditions"][name].features, condition.features)
            assert torch.equal(batch["conditions"][name].mask, condition.mask)


def test_audio_statistics_are_those_of_all_rows_at_once(
    data: ShardDataset, heard: AudioStats, tmp_path: Path
) -> None:
    rows = np.concatenate([a for i in range(len(data)) if (a := data.audio(i)) is not None]).astype(
        np.float64
    )
    assert heard.frames == len(rows)
    assert np.allclose(heard.mean, rows.mean(0), rtol=1e-6, atol=1e-6)
    std = rows.std(0)
    assert std[2] == 0
    std[2] = 1.0
    assert np.allclose(heard.std, std, rtol=1e-6)
    heard.save(tmp_path / "audio.safetensors")
    again = AudioStats.load(tmp_path / "audio.safetensors")
    assert np.array_equal(again.mean, heard.mean)
    assert np.array_equal(again.std, heard.std)
    assert again.frames == heard.frames
    (tmp_path / "broken").write_bytes(b"no")
    with pytest.raises(UserError, match="not audio statistics"):
        AudioStats.load(tmp_path / "broken")


def test_mistakes_are_named(
    data: ShardDataset, stats: FeatureStats, heard: AudioStats, text: TextCache, tmp_path: Path
) -> None:
    words = written(tmp_path / "words", count=12, every=0)
    with pytest.raises(UserError, match=r"no clip .* audio features"):
        compute_audio(words)
    with pytest.raises(UserError, match=r"balance.audio is 1, but no usable clip"):
        ConditionBatches(words, stats, text, heard, batch_size=4, max_frames=16, balance=Balance(audio=1))
    with pytest.raises(UserError, match="does not divide over 3 ranks"):
        ConditionBatches(data, stats, text, heard, batch_size=4, max_frames=16, world=3)
    with pytest.raises(UserError, match="needs a weight above 0"):
        Balance.parse({}, "balance")
    with pytest.raises(UserError, match="a row never loses both"):
        Drop.parse({"text": 0.7, "audio": 0.7}, "drop")
    double = written(tmp_path / "double", count=4, rate=2)
    batches = ConditionBatches(double, stats, text, heard, batch_size=4, max_frames=16)
    with pytest.raises(UserError, match="one row a motion frame"):
        batches[0]
    with pytest.raises(UserError, match="of kind audio"):
        EvalConditionBatches(words, stats, text, heard, batch_size=4, max_frames=16, kinds=["audio"])


def test_samples_say_which_frames_a_batch_holds(
    data: ShardDataset, stats: FeatureStats, heard: AudioStats, text: TextCache
) -> None:
    batches = ConditionBatches(data, stats, text, heard, batch_size=20, max_frames=24, min_frames=16)
    batch = batches[3]
    for row, (clip, first, length) in zip(batch["motion"].numpy(), batches.samples(3), strict=True):
        frames = data.motion(data.ids.index(clip))[first : first + length]
        assert np.allclose(stats.normalize(frames), row[:length], atol=1e-5)
    assert [sample.length for sample in batches.samples(3)] == batch["length"].tolist()
