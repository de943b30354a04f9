"""A run that a bucket keeps: each machine has an empty disk and is killed, and the bytes are the same."""

from __future__ import annotations

import hashlib
import importlib
import signal
import subprocess
import sys
from pathlib import Path

import pytest

RECIPE = """
name: mirrored
seed: 5
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data: {kind: synth, clips: 24, min_seconds: 2.0, max_seconds: 5.0, layout: body133}
  stats: {kind: stats}
  tokenizer:
    kind: vq
    net: {width: 16, depth: 1, code_dim: 8, num_codes: 16}
    train: {steps: 24, batch_size: 8, checkpoint_every: 4, validate_every: 12}
"""


MACHINE = """
import os, signal, sys, threading
from motionloom.datasets.shards.store import RemoteStore
from motionloom.pipeline.runs.api import run_recipe

recipe, out, mirror, puts, seconds = sys.argv[1:]
put = RemoteStore.put
left = iter(range(int(puts)))


def killed(self, path, name, sha256):
    if next(left, None) is None:
        os.kill(os.getpid(), signal.SIGKILL)
    put(self, path, name, sha256)


RemoteStore.put = killed
clock = threading.Timer(float(seconds), os.kill, (os.getpid(), signal.SIGKILL))
clock.daemon = True
clock.start()
run_recipe(recipe, out, mirror=mirror or None)
os._exit(0)
"""
"""A run that is killed in the middle of a put after so many, or after so many seconds. A process of its own:
torch trains in no fork of one that has trained."""


def made(run: Path) -> dict[str, str]:
    """sha256 of what stages have made."""
    files = [path for path in sorted(run.glob("stages/*/*")) if path.suffix in (".json", ".safetensors")]
    return {
        path.relative_to(run).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
        if path.name not in ("started.json", "timing.json")
    }


@pytest.mark.slow
def test_killed_anywhere_on_machines_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(RECIPE)
    (tmp_path / "empty").mkdir()
    with importlib.import_module("loopback").bucket(tmp_path / "empty", every=0) as (environment, _):
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        codes = []
        tries: list[tuple[int, float]] = [
            (999, 600.0),
            (3, 600.0),
            (9, 600.0),
            (1, 600.0),
            (4, 600.0),
            (2, 12.0),
        ]
        for number, (puts, seconds) in enumerate([*tries, (999, 600.0), (0, 600.0)]):
            place = "s3://shards/run" if number else ""
            words = [recipe, tmp_path / str(number), place, str(puts), str(seconds)]
            codes.append(subprocess.run([sys.executable, "-P", "-c", MACHINE, *words]).returncode)
        assert codes == [0, *[-signal.SIGKILL] * 5, 0, 0]
        whole = made(tmp_path / "0")
        assert len(whole) == 6 and made(tmp_path / "6") == whole
        assert made(tmp_path / "7") == whole, "of a run that is finished all is fetched, and nothing is sent"
