"""Training from an S3 server over a bad network gives the losses of training from the disk, bit for bit."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from motionloom.datasets.shards import store as retry
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.writer import write_dataset
from motionloom.datasets.synth.generate import SynthConfig, make_sample, split_of
from motionloom.models.training import stage_module
from motionloom.pipeline.training import trainer

pytestmark = pytest.mark.slow

Call = Callable[..., Any]
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
    out = tmp_path_factory.mktemp("shards")
    config = SynthConfig(clips=60, min_seconds=2.0, max_seconds=5.0)
    write_dataset(
        out,
        [(split_of(number, config), number) for number in range(config.clips)],
        partial(make_sample, config=config),
        DatasetFacts("made", config.motion_layout, "CC0", converter="test", converter_version=1, options={}),
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
    call: Call,
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
    shards: Path, loopback: ModuleType, tmp_path: Path, call: Call
) -> None:
    with loopback.web(shards) as (url, _):
        common = {"path": url, "order": "streamed"}
        old, new = ({"folder": str(tmp_path / name)} for name in "ab")
        first = recipe(tmp_path, "one", {**common, "cache": old})
        assert call("run", first, "--out", tmp_path / "run", "--until", "stats").code == 0
        second = recipe(tmp_path, "two", {**common, "mode": "streamed", "cache": new})
        done = call("run", second, "--out", tmp_path / "run", "--until", "tokenizer", "--replace")
        assert done.code == 0 and "1 of 5 " in done.out, done.out
        assert list((tmp_path / "b").glob("*.tar")), "the finished data stage hands the new cache on"
        third = recipe(tmp_path, "three", {"path": url, "order": "global", "cache": new})
        plan = call("run", third, "--out", tmp_path / "run", "--dry-run", "--replace")
        assert "5 of 5 " in plan.out and "changed: " in plan.out, plan.out
