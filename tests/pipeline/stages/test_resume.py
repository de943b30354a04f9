"""A run that was killed ends with the same bytes as one that was not."""

from __future__ import annotations

import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from motionloom.pipeline.training.checkpointing import readable

pytestmark = pytest.mark.slow

Moment = Callable[[Path], bool]

# When each of the killed runs dies: in a stage, as soon as its folder looks like this.
MOMENTS: dict[str, Moment] = {
    "data": lambda folder: any((folder / "shards").glob("*")),
    "tokenizer": lambda folder: (folder / "checkpoints/step=00000006.ckpt").is_file(),
    "tokens": lambda folder: (folder / "started.json").is_file(),
    "gpt": lambda folder: (folder / "checkpoints/step=00000012.ckpt").is_file(),
}


def kill(process: Any) -> None:
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def artifacts(run: Path) -> dict[str, str]:
    return {path.parent.name: path.read_text() for path in run.glob("stages/*/artifact.json")}


def test_a_run_killed_four_times_equals_the_undisturbed_one(
    small_run: Any, start: Callable[..., Any], tmp_path: Path
) -> None:
    run = tmp_path / small_run.folder.name
    for stage, moment in MOMENTS.items():
        folder = run / "stages" / stage
        process = start("run", small_run.recipe, "--out", run)
        end = time.monotonic() + 120
        while not moment(folder):
            assert process.poll() is None and time.monotonic() < end, process.communicate()[0]
            time.sleep(0.001)
        kill(process)
        assert not (folder / "artifact.json").exists(), f"{stage} was over before the kill"
    newest = next(readable(run / "stages/gpt/checkpoints"))[0]
    assert newest is not None
    newest.write_bytes(newest.read_bytes()[: newest.stat().st_size // 2])
    process = start("run", small_run.recipe, "--out", run)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert "resuming gpt at step " in output
    assert "tokenizer (" not in output
    assert artifacts(run) == artifacts(small_run.folder)
    assert len(list(run.glob("stages/tokenizer/checkpoints/*"))) == 2
    assert not list(run.rglob("*.tmp")) and not list(run.glob("stages/.*"))


@pytest.mark.parametrize("stage", ["tokenizer", "gpt"])
def test_killed_between_the_last_step_and_the_artifact(
    stage: str, small_run: Any, tmp_path: Path, call: Callable[..., Any]
) -> None:
    run = tmp_path / small_run.folder.name
    shutil.copytree(small_run.folder, run)
    for name in ("artifact.json", "model.json", "model.safetensors"):
        (run / "stages" / stage / name).unlink()
    done = call("run", small_run.recipe, "--out", run)
    assert done.code == 0 and "1 of 15 " in done.out
    assert artifacts(run) == artifacts(small_run.folder)
