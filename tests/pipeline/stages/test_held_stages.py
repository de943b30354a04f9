"""Tokens, batches for the GPTs and figures of clips without hands or a face."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from toy_gpt import encode_split

from motionloom.datasets.loading.statistics import FeatureStats, compute
from motionloom.datasets.motion.layout import Part
from motionloom.datasets.schema import FACE, HANDS
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.tokenizer.body_hand import H2VQConfig
from motionloom.models.tokenizer.single import RvqConfig
from motionloom.pipeline.evaluation.estimate import row_estimates
from motionloom.pipeline.evaluation.reconstruction import face_errors, reconstruction_errors
from motionloom.pipeline.evaluation.truth import Truth, reconstruct_truth, truth_of
from motionloom.pipeline.store.networks import TrainedTokenizer
from motionloom.pipeline.store.tokens import TokenBatches, TokenStore, gpt_clips

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
    whole = loaded.whole_clips()
    kept = np.flatnonzero(store.whole)
    assert 0 < len(kept) < len(dataset) and len(whole.groups) == len(kept) and whole.whole.all()
    for row, clip in enumerate(kept.tolist()):
        one = whole.of(np.arange(len(kept)) == row)
        for name, codes in store.of(np.arange(len(dataset)) == clip).codes.items():
            assert torch.equal(one.codes[name], codes)
    everything = replace(loaded, whole=np.ones(len(dataset), dtype=bool))
    assert everything.whole_clips() is everything


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
