"""Search by text and example: half precision against floats, a file that goes stale, and what is refused."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Decisions
from motionloom.datasets.loading.statistics import FeatureStats, compute
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.pipeline.curation import search as searching
from motionloom.pipeline.curation.search import INDEX_FILE, Search, alignment_model
from motionloom.pipeline.curation.suspects import decide
from motionloom.pipeline.store.networks import LoadedTma


class Words:
    """Token features by the text alone, as an encoder gives them."""

    def tokens(self, captions: Sequence[str]) -> tuple[Any, Any]:
        seeds = [int.from_bytes(hashlib.sha256(text.encode()).digest()[:4]) for text in captions]
        rows = [np.random.default_rng(seed).standard_normal((3, 6)) for seed in seeds]
        return np.array(rows, np.float32), np.ones((len(rows), 3), bool)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    synthesize(SynthConfig(clips=24, seed=5, layout="body133", val_fraction=0.0), folder)
    return folder


@pytest.fixture
def model(root: Path, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A TMA that has learned nothing, in the place of all that are asked for, and how often it embeds."""
    torch.manual_seed(0)
    train = ShardDataset.open(root, "train")
    sizes = TmaConfig(latent=16, ff=32, layers=1, heads=2, frame_stride=4)
    net = Tma.of_layout(sizes, train.layout, "bodyhand", 6).eval()
    stats: FeatureStats = compute(train)
    found = SimpleNamespace(weights="one", embedded=0)
    tma = LoadedTma(net, train.layout, 196, "bodyhand", {"stats": stats, "text": Words()})
    plain = searching._embedded

    def embedded(*arguments: Any) -> Any:
        found.embedded += 1
        return plain(*arguments)

    monkeypatch.setattr(searching, "alignment_model", lambda name, device: (tma, found.weights))
    monkeypatch.setattr(searching, "_embedded", embedded)
    monkeypatch.setattr(searching, "LEAST_PRECISION", 0.0)
    (root / INDEX_FILE).unlink(missing_ok=True)
    return found


def test_made_once_for_these_clips_and_weights(root: Path, model: SimpleNamespace) -> None:
    first = Search.open(root, "any")
    content = (root / INDEX_FILE).read_bytes()
    again = Search.open(root, "any")
    assert model.embedded == 1 and (root / INDEX_FILE).read_bytes() == content
    np.testing.assert_array_equal(first.vectors, again.vectors)
    model.weights = "other"
    Search.open(root, "any")
    assert model.embedded == 2 and (root / INDEX_FILE).read_bytes() != content
    model.weights = "one"
    objects = io.BytesIO()
    np.savez(objects, allow_pickle=True, made_from=np.array([print]), vectors=np.array([print]))
    for spoilt in (content[:-40], b"", content.replace(b"vectors", b"vectord"), objects.getvalue()):
        (root / INDEX_FILE).write_bytes(spoilt)
        Search.open(root, "any")
        assert (root / INDEX_FILE).read_bytes() == content


def test_words_neighbours_and_what_is_left_out(root: Path, model: SimpleNamespace) -> None:
    found = Search.open(root, "any")
    hits = found.best(found.words("a person waves"), 5)
    scores = [hit.score for hit in hits]
    assert scores == sorted(scores, reverse=True) and len({hit.id for hit in hits}) == 5
    own = found.best(found.clip(hits[0].id), 3)
    assert own[0].id == hits[0].id and own[0].score == pytest.approx(1, abs=0.01)
    assert hits[0].id not in {hit.id for hit in found.best(found.clip(hits[0].id), 30, hits[0].id)}
    decide(root, Decisions(left_out={hits[0].id: "bad"}), "given")
    later = Search.open(root, "any")
    assert model.embedded == 1, "what was decided leaves the embeddings as they are"
    assert len(later.best(later.words("a person waves"), 30)) == 23
    decide(root, Decisions(kept=(hits[0].id,)), "given")
    with pytest.raises(UserError, match="no clip 'nobody'"):
        found.clip("nobody")
    with pytest.raises(UserError, match="no words"):
        found.words("  ")


def test_command(root: Path, model: SimpleNamespace, call: Callable[..., Any]) -> None:
    """Three ways to ask, the last with a clip that is not in the set."""
    by_words = json.loads(call("search", root, "a person waves", "--json").out)
    assert [*by_words[0]] == ["id", "split", "score", "caption"] and len(by_words) == 12
    first = by_words[0]["id"]
    alike = call("search", root, "--like", first)
    assert alike.code == 0 and first not in alike.out and len(alike.out.splitlines()) >= 12
    assert call("search", root, "--like", "nobody").code == 2
    assert call("search", root, "words", "--like", first).code == 2


def test_clips_from_files(root: Path, model: SimpleNamespace, tmp_path: Path) -> None:
    """A clip of the set finds itself, by its columns, by its joints and at another frame rate."""
    found = Search.open(root, "any")
    dataset = found.splits["train"]
    joints = searching.floored_joints(dataset, 0)
    facts = np.array(json.dumps({"fps": 2 * dataset.layout.fps}))
    np.save(tmp_path / "columns.npy", dataset.motion(0))
    np.save(tmp_path / "joints.npy", joints)
    np.savez(tmp_path / "twice.npz", joints=np.repeat(joints, 2, axis=0), metadata=facts)
    for path in tmp_path.iterdir():
        [hit] = found.best(found.motion_file(path), 1)
        assert hit.id == dataset.ids[0] and hit.score > 0.98


@pytest.mark.parametrize("shape", [(9, 7, 3), (9, 17), (3, 22, 3)])
def test_arrays_that_are_no_clips(
    shape: tuple[int, ...], root: Path, model: SimpleNamespace, tmp_path: Path
) -> None:
    np.save(tmp_path / "x.npy", np.zeros(shape))
    with pytest.raises(UserError, match=str(shape[1]) if shape[0] > 3 else "3 frames"):
        Search.open(root, "any").motion_file(tmp_path / "x.npy")


def test_captions_that_fit_worse_than_all_others(root: Path, model: SimpleNamespace) -> None:
    """Of a TMA that has learned nothing, the share of misfits is that of the bound."""
    found = Search.open(root, "any")
    misfits = [*found.misfits()]
    assert len(misfits) < 12
    for place, fault in misfits:
        own = {caption.text for caption in found.splits[place.split].texts(place.clip)}
        assert fault.weight > 1 and any(f"'{text}' fits worse" in fault.text for text in own)


def test_a_model_that_cannot_read_the_set_answers_no_words(
    root: Path, model: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against pools of 32 that are drawn; words and doubts about captions are refused, likeness is not."""
    found = Search.open(root, "any")
    rng = np.random.default_rng(0)
    texts = [{caption.text for caption in found.splits[p.split].texts(p.clip)} for p in found.places]
    first = []
    for text in {text for own in texts for text in own}:
        scores = found.vectors @ searching.unit(found.words(text))
        others = [at for at, own in enumerate(texts) if text not in own]
        for own in (at for at, own in enumerate(texts) if text in own):
            pools = rng.choice(scores[others], (300, 31))
            first.append(np.mean((pools > scores[own]).sum(axis=1) < 3))
    assert found.precision == pytest.approx(np.mean(first), abs=0.04) and found.precision < 0.25
    monkeypatch.setattr(searching, "LEAST_PRECISION", 0.3)
    for ask in (lambda: found.words("a person waves"), lambda: [*found.misfits()]):
        with pytest.raises(
            UserError, match=rf"tell .* apart .* {found.precision:.0%} of .* \(by chance 9%\)"
        ):
            ask()
    assert found.best(found.clip(found.ids[0]), 1)


def test_models_without_a_tma(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such folder"):
        alignment_model(tmp_path / "nowhere", "cpu")
    with pytest.raises(UserError, match="has no TMA"):
        alignment_model("dance", "cpu")
