"""Tokens, batches for the GPTs and figures of clips without hands or a face."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from motionloom.datasets.schema import FACE, HANDS
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.statistics import FeatureStats, compute
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.tokenizer.build import build_tokenizer
from motionloom.models.tokenizer.config import H2VQConfig, RvqConfig
from motionloom.pipeline.evaluation import reconstruction_figures
from motionloom.pipeline.samples import truth_of
from motionloom.pipeline.stages.tokens import encode_split
from motionloom.pipeline.token_store import TokenBatches, TokenStore

Data = list[tuple[ShardDataset, FeatureStats]]


@pytest.fixture(scope="module")
def made(borrow: Callable[[str], ModuleType]) -> ModuleType:
    return borrow("held_samples")


@pytest.fixture(scope="module")
def data(made: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Data:
    """The same training clips with zeros and with garbage in what they do not hold."""
    roots = [made.write(tmp_path_factory.mktemp("held"), garbage) for garbage in (0.0, 3.0)]
    opened = [ShardDataset.open(root, "train") for root in roots]
    return [(dataset, compute(dataset)) for dataset in opened]


def tokenizer(data: Data, part: str = "bodyhand") -> Tokenizer:
    torch.manual_seed(0)
    small = {"width": 8, "depth": 1, "code_dim": 8, "num_codes": 8}
    config = RvqConfig(part="face", **small) if part == "face" else H2VQConfig(**small)
    net = build_tokenizer(config, data[0][0].layout)
    net(torch.randn(8, 16, net.dim))
    return net.freeze()


@pytest.mark.parametrize(("part", "bit"), [("bodyhand", HANDS), ("face", FACE)])
def test_tokens_of_clips_that_lack_a_part(data: Data, part: str, bit: int, tmp_path: Path) -> None:
    net = tokenizer(data, part)
    stores = [encode_split(net, dataset, stats, 256) for dataset, stats in data]
    dataset, store = data[0][0], stores[0]
    for name, codes in store.codes.items():
        assert torch.equal(codes, stores[1].codes[name]) and codes.min() >= 0 and codes.max() < 8
    np.testing.assert_array_equal(store.whole, (dataset.held & bit) > 0)
    store.save(tmp_path / "tokens.safetensors")
    loaded = TokenStore.load(tmp_path / "tokens.safetensors", store.per_group)
    whole = loaded.whole_clips()
    kept = np.flatnonzero(store.whole)
    assert 0 < len(kept) < len(dataset) and len(whole.groups) == len(kept) and whole.whole.all()
    for row, clip in enumerate(kept.tolist()):
        for name, codes in store.clip(clip).items():
            assert torch.equal(whole.clip(row)[name], codes)
    everything = replace(loaded, whole=np.ones(len(dataset), dtype=bool))
    assert everything.whole_clips() is everything


def test_gpt_batches_are_of_whole_clips(data: Data) -> None:
    net, (dataset, stats) = tokenizer(data), data[0]
    store = encode_split(net, dataset, stats, 256)
    clips = np.flatnonzero(store.whole)
    batches = TokenBatches(
        store.whole_clips(), [[row] for row in range(len(clips))], torch.eye(len(clips)),
        torch.eye(len(clips)), net.pattern, {s.name: s.num_codes for s in net.streams}, 20, 4, 0,
        sources=dataset.sources(clips),
    )  # fmt: skip
    lengths = {row: 3 * int(store.groups[clip]) for row, clip in enumerate(clips.tolist())}
    seen = set()
    for k in range(6):
        batch = batches[k]
        for row, text in enumerate(batch["text"].argmax(1).tolist()):
            seen.add(text)
            assert int(batch["length"][row]) - lengths[text] in (1, 2), "the tokens of its own clip"
    assert seen == set(range(len(clips)))


def test_figures_do_not_depend_on_what_was_not_recorded(data: Data) -> None:
    net, figures = tokenizer(data), []
    for dataset, stats in data:
        truths = [truth_of(dataset, i) for i in range(len(dataset))]
        assert [t.face is None for t in truths] == ((dataset.held & FACE) == 0).tolist()
        figures.append(reconstruction_figures(net, stats, dataset, truths))
        with_hands = [t for t in truths if t.held & HANDS]
        alone = reconstruction_figures(net, stats, dataset, with_hands)
        assert alone["mpjpe_hand"] == pytest.approx(figures[-1]["mpjpe_hand"])
        assert alone["mpjpe_body"] != pytest.approx(figures[-1]["mpjpe_body"])
    assert figures[0] == pytest.approx(figures[1], rel=1e-6)
