"""A UDE run that was killed in the middle of its trainings ends with the same bytes as one that was not."""

from __future__ import annotations

import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

# When each of the killed runs dies: as soon as this checkpoint is there. The critic has had turns by then.
MOMENTS = {"tokenizer": "step=00000004.ckpt", "utt": "step=00000008.ckpt", "dmd": "step=00000004.ckpt"}


def artifacts(run: Path) -> dict[str, str]:
    return {path.parent.name: path.read_text() for path in run.glob("stages/*/artifact.json")}


def test_a_run_killed_in_every_training_equals_the_undisturbed_one(
    ude_run: Any, start: Callable[..., Any], tmp_path: Path
) -> None:
    run = tmp_path / ude_run.folder.name
    shutil.copytree(ude_run.folder, run)
    for stage in (*MOMENTS, "ude"):
        shutil.rmtree(run / "stages" / stage)
    words = ("run", ude_run.recipe, "--out", run, "--until", "ude")
    for stage, checkpoint in MOMENTS.items():
        folder = run / "stages" / stage
        process = start(*words)
        end = time.monotonic() + 120
        while not (folder / "checkpoints" / checkpoint).is_file():
            assert process.poll() is None and time.monotonic() < end, process.communicate()[0]
            time.sleep(0.001)
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        assert not (folder / "artifact.json").exists(), f"{stage} was over before the kill"
    process = start(*words)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert "resuming dmd at step 4 of 8" in output and "utt (" not in output
    assert artifacts(run) == artifacts(ude_run.folder)
