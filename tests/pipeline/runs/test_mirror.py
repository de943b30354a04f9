"""What is kept in a bucket: whoever puts it there is killed inside an upload, and the bytes are the same."""

from __future__ import annotations

import hashlib
import importlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from bvh_clips import write_source

from motionloom.datasets.shards.store import open_store

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

COMMANDS = {
    "run": ("run", "recipe.yaml", "--out", "{machine}", "--mirror", "{bucket}"),
    "convert": (
        "data", "convert", "bvh", "source", "{bucket}", "--licence", "CC0", "--workers", "1",
        "--set", "look=0", "--set", "joint_map=source/map.json",
    ),
    "copy": ("data", "copy", "set", "{bucket}"),
}  # fmt: skip
"""Each machine has a disk of its own, which is empty."""


def kept(bucket: str, folder: Path) -> dict[str, str]:
    """sha256 of all that lies in a bucket, but times and speeds."""
    store = open_store(bucket)
    timed = ("timing.json", "started.json", "metrics.csv")
    names = [name for name in store.names("") if not name.endswith(timed)]
    for name in names:
        store.get(name, folder / name)
    return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_killed_inside_an_upload(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "recipe.yaml").write_text(RECIPE)
    write_source(tmp_path / "source", [f"walk-{i}" for i in range(12)])
    with importlib.import_module("loopback").bucket(tmp_path / "empty", every=0) as (environment, network):
        for name, value in environment.items():
            monkeypatch.setenv(name, value)

        def start(number: int, bucket: str, put: int | None = None, seconds: float | None = None) -> int:
            """The exit code of the command on machine `number`, killed in a put, or after some seconds."""
            words = [word.format(machine=tmp_path / str(number), bucket=bucket) for word in COMMANDS[command]]
            line = [sys.executable, "-P", "-m", "motionloom", *words]
            process = subprocess.Popen(line, cwd=tmp_path, start_new_session=True)
            network.puts = 0
            network.in_a_put = None if put is None else (put, lambda: os.killpg(process.pid, signal.SIGKILL))
            try:
                return process.wait(seconds)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                return process.wait()

        if command == "copy":
            words = [word.format(bucket=tmp_path / "set") for word in COMMANDS["convert"]]
            subprocess.run([sys.executable, "-P", "-m", "motionloom", *words], cwd=tmp_path, check=True)
        assert start(0, f"s3://shards/{command}-whole") == 0
        puts = {"run": (3, 9, 1, 4), "convert": (0, 2, 1), "copy": (0, 3, 2)}[command]
        codes = [start(at, f"s3://shards/{command}-killed", put) for at, put in enumerate(puts, start=1)]
        assert codes == [-signal.SIGKILL] * len(puts)
        start(7, f"s3://shards/{command}-killed", seconds=6)
        assert start(8, f"s3://shards/{command}-killed") == 0
        whole = kept(f"s3://shards/{command}-whole", tmp_path / "a")
        assert len(whole) > 5 and kept(f"s3://shards/{command}-killed", tmp_path / "b") == whole
        assert start(9, f"s3://shards/{command}-killed", 0) == 0
        assert network.puts == 0, "nothing is sent again"
