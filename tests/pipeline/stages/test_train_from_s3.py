"""Training from an S3 server over a bad network gives the losses of training from the disk, bit for bit."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from motionloom.datasets.schema import SPLITS, Split
from motionloom.datasets.shards import store as retry
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import write_dataset
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.models.training import stage_module
from motionloom.pipeline.training import trainer

pytestmark = pytest.mark.slow

STEPS = 16
RECIPE = f"""
name: s3
seed: 5
hardware: {{accelerator: cpu, threads: 1}}
stages:
  stats: {{kind: stats}}
  text: {{kind: text}}
  tokenizer:
    kind: vq
    net: {{width: 16, depth: 1, code_dim: 8, num_codes: 16}}
    train: {{steps: {STEPS}, batch_size: 8, checkpoint_every: 8, validate_every: 8}}
  tma:
    kind: tma
    net: {{latent: 16, ff: 16, layers: 1, heads: 2}}
    train: {{steps: 6, batch_size: 4, checkpoint_every: 8, validate_every: 8}}
"""


@pytest.fixture(scope="module")
def loopback() -> ModuleType:
    return importlib.import_module("loopback")


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Synthetic clips in small shards."""
    whole, out = tmp_path_factory.mktemp("whole"), tmp_path_factory.mktemp("shards")
    synthesize(SynthConfig(clips=60, min_seconds=2.0, max_seconds=5.0), whole, workers=1)
    splits = {split: ShardDataset.open(whole, split) for split in SPLITS}
    items = [(split, (split, i)) for split, dataset in splits.items() for i in range(len(dataset))]

    def copy(item: tuple[Split, int]) -> Sample:
        dataset, i = splits[item[0]], item[1]
        return Sample(dataset.meta(i), dataset.motion(i), dataset.texts(i), dataset.face_texts(i))

    write_dataset(
        out,
        items,
        copy,
        DatasetFacts(
            "made", splits["train"].layout, "CC0", converter="copy", converter_version=1, options={}
        ),
        WriteOptions(clips_per_shard=8, progress=False),
    )
    return out


def recipe(folder: Path, name: str, data: dict[str, Any]) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(RECIPE + f"  data: {json.dumps({'kind': 'shards', **data})}\n")
    return path


def results(run: Path) -> dict[str, Any]:
    """Every logged loss, and the checksum of every file the stages made, except those that name a place."""
    out: dict[str, Any] = {}
    for stage in ("stats", "text", "tokenizer", "tma"):
        folder = run / "stages" / stage
        if not (folder / "artifact.json").is_file():
            continue
        out[stage] = json.loads((folder / "artifact.json").read_text())["outputs"]
        log = folder / "metrics.jsonl"
        if log.is_file():
            out[f"{stage} losses"] = log.read_text()
    return out


@pytest.mark.parametrize("order", ["global", "streamed"])
def test_the_same_losses_from_s3_with_failing_requests(
    order: str,
    shards: Path,
    loopback: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    call: Callable[..., Any],
) -> None:
    monkeypatch.setattr(retry, "FIRST_PAUSE", 0.01)
    for module in (stage_module, trainer):
        monkeypatch.setattr(module, "LOG_EVERY", 1)

    def run(name: str, last: str | None, **data: Any) -> dict[str, Any]:
        data = {"order": order, "shards_per_group": 2, **data}
        until = ["--until", last] if last else []
        done = call("run", recipe(tmp_path, name, data), "--out", tmp_path / name, *until)
        assert done.code == 0, done.out + done.err
        return results(tmp_path / name)

    want = run("disk", None if order == "global" else "tokenizer", path=str(shards))
    rows = [json.loads(line) for line in want["tokenizer losses"].splitlines()]
    assert [row["step"] for row in rows if "train/loss" in row] == list(range(1, STEPS + 1))
    with loopback.bucket(shards, every=20) as (environment, network):
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        modes = ["indexed"] if order == "global" else ["indexed", "streamed"]
        for mode in modes:
            name, last = mode, None if order == "global" else "tokenizer"
            before = network.requests, network.failures
            cache = {"folder": str(tmp_path / "cache" / name)}
            got = run(name, last, path="s3://shards/made", mode=mode, cache=cache)
            assert got.keys() >= {"stats", "tokenizer losses", "tokenizer" if last else "tma losses"}
            assert all(value == want[key] for key, value in got.items())
            asked, failed = network.requests - before[0], network.failures - before[1]
            print(f"{order}, {name}: {failed} of {asked} requests failed")
            assert asked >= 20 and failed == network.requests // 20 - before[0] // 20 > 0


def test_reader_and_cache_may_change_without_training_again(
    shards: Path, loopback: ModuleType, tmp_path: Path, call: Callable[..., Any]
) -> None:
    with loopback.web(shards) as (url, _):
        common = {"path": url, "order": "streamed"}
        old, new = ({"folder": str(tmp_path / name)} for name in "ab")
        first = recipe(tmp_path, "one", {**common, "cache": old})
        assert call("run", first, "--out", tmp_path / "run", "--until", "stats").code == 0
        second = recipe(tmp_path, "two", {**common, "mode": "streamed", "cache": new})
        done = call("run", second, "--out", tmp_path / "run", "--until", "tokenizer", "--replace")
        assert done.code == 0 and "1 of 5 stages to run" in done.out, done.out
        assert list((tmp_path / "b").glob("*.tar")), "the finished data stage hands the new cache on"
        third = recipe(tmp_path, "three", {"path": url, "order": "global", "cache": new})
        plan = call("run", third, "--out", tmp_path / "run", "--dry-run", "--replace")
        assert "5 of 5 stages would run" in plan.out and "changed: " in plan.out, plan.out


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({}, "key 'path' is required"),
        ({"path": "x", "mode": "streamed"}, "needs order: streamed"),
        ({"path": "x", "cache": {"gigabyte": 3}}, "did you mean 'gigabytes'"),
    ],
)
def test_contradictions_are_named(
    data: dict[str, Any], said: str, tmp_path: Path, call: Callable[..., Any]
) -> None:
    done = call("run", recipe(tmp_path, "wrong", data), "--out", tmp_path / "run")
    assert done.code != 0 and said in " ".join((done.out + done.err).split())
