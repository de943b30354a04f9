"""Tokens, batches for the GPTs and figures of clips without hands or a face."""

from __future__ import annotations

import importlib
import pickle
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
import torch.multiprocessing as mp
from shard_samples import write_made
from toy_gpt import encode_split

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import FACE, HANDS, Caption, Split
from motionloom.datasets.loading.plan import Share
from motionloom.datasets.loading.statistics import FeatureStats, compute
from motionloom.datasets.motion.layout import MotionLayout, Part
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.sample import Sample
from motionloom.models.gpt.tokens import stream_names
from motionloom.models.tokenizer.base import Tokenizer, TokenizerConfig
from motionloom.models.tokenizer.body_hand import H2VQConfig
from motionloom.models.tokenizer.single import RvqConfig, VqConfig
from motionloom.pipeline.evaluation.estimate import row_estimates
from motionloom.pipeline.evaluation.reconstruction import clip_errors, face_errors
from motionloom.pipeline.evaluation.reference_baselines import NearestClip
from motionloom.pipeline.evaluation.truth import Truth, has_caption, reconstruct_truth, spread, truth_of
from motionloom.pipeline.store.networks import TrainedTokenizer
from motionloom.pipeline.store.tokens import GptClips, TokenBatches, TokenStore, gpt_clips

TINY: dict[str, Any] = {"width": 8, "depth": 1, "code_dim": 8, "num_codes": 8}
Data = list[tuple[ShardDataset, FeatureStats]]


@pytest.fixture(scope="module")
def made() -> ModuleType:
    return importlib.import_module("held_samples")


@pytest.fixture(scope="module")
def data(made: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Data:
    """The same training clips with zeros and with garbage in what they do not hold."""
    roots = [made.write(tmp_path_factory.mktemp("present"), garbage) for garbage in (0.0, 3.0)]
    opened = [ShardDataset.open(root, "train") for root in roots]
    return [(dataset, compute(dataset)) for dataset in opened]


def tokenizer(data: Data, part: str = "bodyhand") -> Tokenizer:
    torch.manual_seed(0)
    config = RvqConfig(part="face", **TINY) if part == "face" else H2VQConfig(**TINY)
    net = config.build(data[0][0].layout)
    net(torch.randn(8, 16, net.dim))
    return net.freeze()


@pytest.mark.parametrize(("part", "bit"), [("bodyhand", HANDS), ("face", FACE)])
def test_tokens_of_clips_that_lack_a_part(data: Data, part: str, bit: int, tmp_path: Path) -> None:
    net = tokenizer(data, part)
    stores = [encode_split(net, dataset, stats, 256) for dataset, stats in data]
    dataset, store = data[0][0], stores[0]
    for name, codes in store.codes.items():
        assert torch.equal(codes, stores[1].codes[name]) and codes.min() >= 0 and codes.max() < 8
    np.testing.assert_array_equal(store.whole, (dataset.present & bit) > 0)
    store.save(tmp_path / "tokens.safetensors")
    loaded = TokenStore.load(tmp_path / "tokens.safetensors", store.per_group)
    kept = np.flatnonzero(store.whole)
    assert 0 < len(kept) < len(dataset)
    for name in store.codes:
        own = torch.cat([codes_of(store, clip)[name] for clip in kept.tolist()])
        assert torch.equal(loaded.whole_codes(name), own)


def test_gpt_batches_say_which_tokens_were_recorded(data: Data) -> None:
    """Clips without hands are there, with their hand tokens marked; garbage in the hands changes no batch."""
    net, (dataset, stats) = tokenizer(data), data[0]
    clips = gpt_clips(dataset, encode_split(net, dataset, stats, 256), net, face=False, min_frames=16)
    assert clips.present is not None and len(clips.captions) == len(dataset)
    own = [clips.texts[row] for row in clips.captions.rows[clips.captions.starts[:-1]]]
    number = len(clips.texts)
    batches = TokenBatches(
        clips.store, clips.captions, torch.eye(number), torch.eye(number), net.pattern,
        {s.name: s.num_codes for s in net.streams}, 20, 4, 0, sources=clips.sources, present=clips.present,
    )  # fmt: skip
    hands = {text: bool(bits & HANDS) for text, bits in zip(own, dataset.present.tolist(), strict=True)}
    seen = set()
    for k in range(12):
        batch = batches[k]
        known, kinds = batch["known"], batch["kinds"]
        assert known.shape == kinds.shape and known[kinds == 0].all(), "the body was recorded"
        end = batch["tokens"] == 8
        assert known[end].all(), "where a motion ends is known"
        for row, at in enumerate(batch["text"].argmax(1).tolist()):
            text = clips.texts[at]
            if text not in hands:  # a caption that clips share
                continue
            seen.add(text)
            codes = (kinds[row] == 1) & ~end[row]
            assert codes.any() and (known[row][codes] == hands[text]).all()
            assert batch["present"][row].all() == hands[text]
            hand = torch.from_numpy(np.isin(net.columns.numpy(), dataset.layout.part("hand")))
            assert torch.equal(batch["present"][row], torch.full_like(hand, True) if hands[text] else ~hand)
    assert {hands[text] for text in seen} == {True, False}


@pytest.mark.parametrize("cores", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_captions_are_the_same_however_many_read_them(
    data: Data, monkeypatch: pytest.MonkeyPatch, cores: int
) -> None:
    net, (dataset, stats) = tokenizer(data), data[0]
    store = encode_split(net, dataset, stats, 256)
    one = gpt_clips(dataset, store, net, face=False, min_frames=16)
    monkeypatch.setattr("motionloom.pipeline.store.tokens._OF_A_WORKER", 3)
    monkeypatch.setattr("motionloom.pipeline.store.tokens.usable_cores", lambda: cores)
    other = gpt_clips(dataset, store, net, face=False, min_frames=16)
    assert other.texts == one.texts and len(one.texts) > 3
    for name, values in vars(one.captions).items():
        np.testing.assert_array_equal(getattr(other.captions, name), values)


def reconstruction_errors(
    trained: TrainedTokenizer, dataset: ShardDataset, truths: Sequence[Truth]
) -> dict[str, float]:
    """Mean errors over all clips of `truths` in mm."""
    pairs = zip(truths, NearestClip(dataset).motions(truths), strict=True)
    rows = [clip_errors(trained, near, truth, reconstruct_truth(trained, truth)) for truth, near in pairs]
    return {name: one.value for name, one in row_estimates([rows]).items()}


def test_figures_do_not_depend_on_what_was_not_recorded(data: Data) -> None:
    net, figures = tokenizer(data), []
    for dataset, stats in data:
        truths = [truth_of(dataset, i) for i in range(len(dataset))]
        assert [t.face is None for t in truths] == ((dataset.present & FACE) == 0).tolist()
        trained = TrainedTokenizer(net, {"stats": stats})
        figures.append(reconstruction_errors(trained, dataset, truths))
        with_hands = [t for t in truths if t.present & HANDS]
        alone = reconstruction_errors(trained, dataset, with_hands)
        assert alone["mpjpe_hand"] == pytest.approx(figures[-1]["mpjpe_hand"])
        assert alone["mpjpe_body"] != pytest.approx(figures[-1]["mpjpe_body"])
    assert figures[0] == pytest.approx(figures[1], rel=1e-6)


@pytest.mark.parametrize("part", ["all", "bodyhand", "body"])
def test_a_clip_through_a_tokenizer_of_any_part(data: Data, part: Part) -> None:
    dataset, stats = data[0]
    net = RvqConfig(**TINY, part=part).build(dataset.layout).freeze()
    trained = TrainedTokenizer(net, {"stats": stats})
    hand = np.isin(dataset.layout.part("bodyhand"), dataset.layout.part("hand"))
    mean = stats.mean[dataset.layout.part("bodyhand")]
    for truth in (truth_of(dataset, i) for i in range(4)):
        rebuilt = reconstruct_truth(trained, truth)
        assert rebuilt.shape == truth.features.shape
        modelled = part != "body" and truth.present & HANDS
        assert np.allclose(rebuilt[:, hand], mean[hand]) == (not modelled)
        assert not np.allclose(rebuilt[:, ~hand], mean[~hand])
    figures = reconstruction_errors(trained, dataset, [truth_of(dataset, 0)])
    assert np.isfinite(list(figures.values())).all()


def errors(trained: TrainedTokenizer, truths: list[Truth]) -> dict[str, float]:
    rows = [face_errors(trained, truth) for truth in truths]
    return {name: one.value for name, one in row_estimates([rows]).items()}


def test_faces_count_where_there_are_any(data: Data) -> None:
    """Garbage in faces that were never recorded changes nothing, and a face by hand."""
    net, found = tokenizer(data, "face"), []
    for dataset, stats in data:
        trained = TrainedTokenizer(net, {"stats": stats})
        truths = [truth_of(dataset, i) for i in range(len(dataset))]
        found.append(errors(trained, truths))
        faces = [t.face for t in truths if t.face is not None]
        assert 0 < len(faces) < len(truths)
        columns = dataset.layout.slice("face")
        apart = np.concatenate([np.linalg.norm(face - stats.mean[columns], axis=1) for face in faces])
        assert found[-1]["expression_mean"] == pytest.approx(apart.mean(), rel=1e-5)
        assert errors(trained, [t for t in truths if t.face is None]) == {}
    assert found[0] == pytest.approx(found[1], rel=1e-6) and found[0]["expression"] > 0


# What a GPT trains on: captions about a part of a clip, clips without captions, clips without hands.

LAYOUT = MotionLayout.named("wholebody363")  # 30 fps
FRAMES = 90
WALKS = Caption(text="walks", start=0.0, end=1.0)
SITS = Caption(text="sits", start=1.0, end=2.5)
BLINK = Caption(text="blinks", start=2.0, end=2.05)
ALL = Caption(text="everything")
GROUPS = {"walks": (0, 8), "sits": (8, 19), "everything": (0, 22)}
"""Groups of four frames with the borders nearest to those above."""


@dataclass(frozen=True)
class Convert:
    """Clip i has the captions `texts[i]`, the face captions `faces[i]` and holds the bits `present[i]`."""

    texts: Sequence[list[Caption]]
    faces: Sequence[list[Caption]] = ()
    present: Sequence[int] = ()

    def __call__(self, i: int) -> Sample:
        motion = np.random.default_rng(i).standard_normal((FRAMES, LAYOUT.dim)).astype(np.float32)
        meta = LAYOUT.clip_meta(
            f"clip{i}", source="made", split="train", frames=FRAMES, licence="CC0",
            has_hands=not self.present or bool(self.present[i] & HANDS), truth={"action": "none"},
        )  # fmt: skip
        faces = list(self.faces[i]) if self.faces else []
        return Sample(meta, motion, texts=list(self.texts[i]), face_texts=faces)


def dataset_of(out: Path, convert: Convert) -> ShardDataset:
    items: list[tuple[Split, int]] = [("train", i) for i in range(len(convert.texts))]
    return ShardDataset.open(write_made(out, items, convert, LAYOUT, clips_per_shard=3), "train")


def places(dataset: ShardDataset) -> list[int]:
    """Where clip 0, 1, ... came to lie: shards are shuffled when they are written."""
    return [dataset.ids.index(f"clip{i}") for i in range(len(dataset))]


def clips_of(
    dataset: ShardDataset, *, face: bool = False, config: TokenizerConfig | None = None
) -> tuple[GptClips, TokenStore, Tokenizer]:
    torch.manual_seed(0)
    small = {"width": 8, "depth": 1, "code_dim": 8, "num_codes": 8}
    net = (config or H2VQConfig(**small)).build(dataset.layout)
    net(torch.randn(8, 16, net.dim))
    net.freeze()
    store = encode_split(net, dataset, compute(dataset), 512)
    return gpt_clips(dataset, store, net, face=face, min_frames=16), store, net


def batches_of(clips: GptClips, net: Tokenizer, *, most: int = 40, training: bool = True) -> TokenBatches:
    eye, ends = torch.eye(len(clips.texts)), {s.name: s.num_codes for s in net.streams}
    return TokenBatches(
        clips.store, clips.captions, eye, eye, net.pattern, ends, most, 4, 0, training=training,
        sources=clips.sources, present=clips.present,
    )  # fmt: skip


@pytest.mark.parametrize("captions", [[WALKS, SITS], [SITS, WALKS, ALL, BLINK]])
def test_a_caption_comes_with_its_own_stretch(tmp_path: Path, captions: list[Caption]) -> None:
    clips, _, net = clips_of(dataset_of(tmp_path, Convert([captions] * 2)))
    assert clips.texts == [c.text for c in captions if c is not BLINK], "too short beside longer ones"
    own = clips.captions
    for row, first, count in zip(own.rows, own.first, own.count, strict=True):
        assert (first, first + count) == GROUPS[clips.texts[row]]
    first = batches_of(clips, net, training=False)[0]
    assert clips.texts[int(first["text"][0].argmax())] == captions[0].text


def test_truth_is_what_the_caption_is_about(tmp_path: Path) -> None:
    texts = [[WALKS, SITS], [SITS, ALL], [], [BLINK, SITS]]
    faces = [[Caption(text="frowns", start=1.5), Caption(text="smiles", end=1.0)], [ALL], [], []]
    dataset = dataset_of(tmp_path, Convert(texts, faces))
    where = places(dataset)
    truths = [truth_of(dataset, i) for i in where]
    assert [t.caption for t in truths] == ["walks", "everything", "", "sits"]
    assert [t.face_caption for t in truths] == ["smiles", "everything", "", "sits"]
    spans = [(0, 28), (0, 88), (0, 88), (30, 74)]
    for i, (truth, (first, end)) in enumerate(zip(truths, spans, strict=True)):
        np.testing.assert_array_equal(
            truth.features, dataset.motion(where[i])[first:end, LAYOUT.part("bodyhand")]
        )
        assert truth.face is not None and len(truth.face) == len(truth.joints) == end - first
    assert [t.truth is None for t in truths] == [True, False, False, True], "of whole clips alone"
    assert has_caption(dataset)[where].tolist() == [True, True, False, True]
    assert set(spread(dataset, 10)) == set(where) - {where[2]}


@pytest.mark.parametrize("face", [False, True])
def test_clips_without_a_caption_are_left_out(tmp_path: Path, face: bool) -> None:
    some: list[list[Caption]] = [[ALL], [], [WALKS], [], []]
    everywhere = [[ALL]] * 5
    dataset = dataset_of(tmp_path, Convert(everywhere if face else some, some if face else everywhere))
    clips, _, net = clips_of(dataset, face=face)
    assert clips.uncaptioned == 3 and set(clips.texts) == {"everything", "walks"}
    assert len(clips.captions) == 2
    assert clips.captions.clips.tolist() == sorted([places(dataset)[0], places(dataset)[2]])
    assert batches_of(clips, net)[0]["tokens"].shape[0] == 4


def test_one_process_reads_captions_and_others_map_them(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path, Convert([[ALL], [], [WALKS, SITS]]))
    alone, store, net = clips_of(dataset)
    asked: list[list[str]] = []

    def of_texts(texts: list[str]) -> dict[str, Any]:
        asked.append(texts)
        return {"latents": torch.eye(len(texts)).numpy()}

    given = {"face": False, "min_frames": 16, "of_texts": of_texts, "note": tmp_path / "work" / "train"}
    first, second = (gpt_clips(dataset, store, net, **given) for _ in range(2))
    for clips in (first, second, pickle.loads(pickle.dumps(second))):
        for name, values in vars(alone.captions).items():
            np.testing.assert_array_equal(vars(clips.captions)[name], values)
        np.testing.assert_array_equal(clips.tables["latents"], torch.eye(3).numpy())
    assert asked == [alone.texts]
    assert len(pickle.dumps(second.tables)) < 300 + 2 * len(str(tmp_path)), "sent by name"
    np.testing.assert_array_equal(
        pickle.loads(pickle.dumps(second.captions.rows[1:])), second.captions.rows[1:]
    )


def test_no_caption_at_all_is_refused(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path, Convert([[ALL], [WALKS]]))
    with pytest.raises(UserError, match=r"'train' .*face caption"):
        clips_of(dataset, face=True)
    silent = dataset_of(tmp_path / "silent", Convert([[], []]))
    with pytest.raises(UserError, match=r"'train' .*a caption"):
        clips_of(silent)
    with pytest.raises(UserError, match=r"'train' .*a caption"):
        spread(silent, 4)


def test_a_tokenizer_without_a_hand_stream_needs_hands(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path, Convert([[ALL]] * 3, present=(3, 2, 3)))
    config = VqConfig(width=8, depth=1, code_dim=8, num_codes=8)
    clips, _, _ = clips_of(dataset, config=config)
    assert len(clips.captions) == 2 and clips.present is None and clips.uncaptioned == 0
    bare = dataset_of(tmp_path / "bare", Convert([[ALL]] * 2, present=(2, 2)))
    with pytest.raises(UserError, match="the tokenizer models"):
        clips_of(bare, config=VqConfig(width=8, depth=1, code_dim=8, num_codes=8, part="bodyhand"))


def test_tokens_of_another_tokenizer_are_refused(tmp_path: Path) -> None:
    clips, store, net = clips_of(dataset_of(tmp_path, Convert([[SITS]])))
    store.codes["hand"][3] = 8
    with pytest.raises(UserError, match=r"'hand'.*8 codes.*tokens stage"):
        batches_of(clips, net)


def codes_of(store: TokenStore, clip: int) -> dict[str, torch.Tensor]:
    """The codes of one clip."""
    first, end = store.starts[clip : clip + 2]
    return {
        name: flat[first * n : end * n]
        for (name, flat), n in zip(store.codes.items(), store.per_group.values(), strict=True)
    }


def sequence_by_sequence(batches: TokenBatches, k: int) -> dict[str, torch.Tensor]:
    """The slow obvious way: one row after the other, token by token, padded to the longest."""
    captions, pattern, names = batches.captions, batches.pattern, stream_names(batches.pattern)
    turns, items = batches._plan.local(k, batches.share)
    rows, texts = [], []
    for turn, item in zip(turns.tolist(), items.tolist(), strict=True):
        rng = np.random.default_rng([batches.seed, turn, item])
        own = range(captions.starts[item], captions.starts[item + 1])
        chosen = own[int(rng.integers(len(own)))]
        first, count = int(captions.first[chosen]), int(captions.count[chosen])
        most = min(count, batches.max_groups)
        first += int(rng.integers(count - most + 1)) if count > most else 0
        per_group, tokens = batches.store.per_group, []
        codes = {n: c[first * per_group[n] :].tolist() for n, c in codes_of(batches.store, item).items()}
        for _ in range(most):
            tokens += [(codes[name].pop(0), names.index(name)) for name in pattern]
        tokens += [(batches.ends[name], names.index(name)) for name in names] if most == count else []
        rows.append(tokens)
        texts.append(int(captions.rows[chosen]))
    size = max(map(len, rows))
    padded = torch.tensor([row + [(-1, 0)] * (size - len(row)) for row in rows])
    return {
        "tokens": padded[..., 0],
        "kinds": padded[..., 1],
        "length": torch.tensor([len(row) for row in rows]),
        "text": batches.prior[texts],
        "similarity": batches.similarity[texts],
    }


@pytest.mark.parametrize("most", [5, 40])
@pytest.mark.parametrize("config", [None, VqConfig(width=8, depth=1, code_dim=8, num_codes=8)])
def test_batches_hold_what_one_sequence_after_the_other_gives(
    tmp_path: Path, most: int, config: TokenizerConfig | None
) -> None:
    texts = [[WALKS, SITS, ALL], [SITS], [WALKS, BLINK], [ALL, WALKS], [WALKS]]
    clips, _, net = clips_of(dataset_of(tmp_path, Convert(texts)), config=config)
    for rank in range(2):
        batches = replace(batches_of(clips, net, most=most), share=Share(rank, 2), seed=most**30)
        for k in range(6):
            wanted, batch = sequence_by_sequence(batches, k), batches[k]
            assert batch.keys() == wanted.keys()
            for name, values in wanted.items():
                assert batch[name].dtype == values.dtype and torch.equal(batch[name], values), (k, name)


def test_loader_workers_share_tokens_and_embeddings(tmp_path: Path) -> None:
    clips, _, net = clips_of(dataset_of(tmp_path, Convert([[ALL], [WALKS]])))
    batches = batches_of(clips, net)
    mp.reducer.ForkingPickler.dumps(batches)  # as `spawn` sends them
    tables = (*batches.store.codes.values(), batches.prior, batches.similarity)
    assert all(table.is_shared() for table in tables)
