"""Training on shards of a server: which reader and which cache serve them is no part of the result."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from shard_samples import write_made

from motionloom.datasets.synth.generate import SynthConfig, make_sample, split_of

pytestmark = pytest.mark.slow

Call = Callable[..., Any]
RECIPE = """
name: s3
seed: 5
hardware: {accelerator: cpu, threads: 1}
stages:
  stats: {kind: stats}
  text: {kind: text}
  tokenizer:
    kind: vq
    net: {width: 16, depth: 1, code_dim: 8, num_codes: 16}
    train: {steps: 4, batch_size: 8, checkpoint_every: 8, validate_every: 8}
  tma: {kind: tma, net: {latent: 16, ff: 16, layers: 1, heads: 2}, train: {steps: 6, batch_size: 4}}
"""


@pytest.fixture(scope="module")
def loopback() -> ModuleType:
    return importlib.import_module("loopback")


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Synthetic clips in small shards."""
    out = tmp_path_factory.mktemp("shards")
    config = SynthConfig(clips=60, min_seconds=2.0, max_seconds=5.0)
    items = [(split_of(number, config), number) for number in range(config.clips)]
    make = partial(make_sample, config=config)
    return write_made(out, items, make, config.motion_layout, clips_per_shard=8)


def recipe(folder: Path, name: str, data: dict[str, Any]) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(RECIPE + f"  data: {json.dumps({'kind': 'shards', **data})}\n")
    return path


def test_the_cache_may_change_without_training_again(
    shards: Path, loopback: ModuleType, tmp_path: Path, call: Call
) -> None:
    with loopback.web(shards) as (url, _):
        common = {"path": url, "order": "streamed"}
        old, new = ({"folder": str(tmp_path / name)} for name in "ab")
        first = recipe(tmp_path, "one", {**common, "cache": old})
        assert call("run", first, "--out", tmp_path / "run", "--until", "stats").code == 0
        second = recipe(tmp_path, "two", {**common, "cache": new})
        done = call("run", second, "--out", tmp_path / "run", "--until", "tokenizer", "--replace")
        assert done.code == 0 and "1 of 5 " in done.out, done.out
        assert list((tmp_path / "b").glob("*.tar")), "the finished data stage hands the new cache on"
        third = recipe(tmp_path, "three", {"path": url, "order": "global", "cache": new})
        plan = call("run", third, "--out", tmp_path / "run", "--dry-run", "--replace")
        assert "5 of 5 " in plan.out and "changed: " in plan.out, plan.out
