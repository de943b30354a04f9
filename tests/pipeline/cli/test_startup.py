"""Commands that compute next to nothing import next to nothing.

Two processes run them in turn, from the lightest on, and say after each which libraries have come in.
"""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

HEAVY = (
    "torch", "torch._dynamo", "lightning", "torchmetrics", "transformers", "sentence_transformers",
    "huggingface_hub", "scipy", "librosa", "soundfile", "roma", "PIL", "matplotlib", "webdataset",
)  # fmt: skip

PROGRAM = """
import contextlib, io, json, sys
from motionloom.pipeline.cli import main as cli
heavy, commands = json.loads(sys.argv[1])
for words in commands:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
        sys.argv = ["motionloom", *words]
        code = cli._exit_code()
    assert code == 0, (words, said.getvalue())
    print(json.dumps([name for name in heavy if name in sys.modules]))
"""


WITHOUT = ("version", "help", "run help", "convert help", "tables", "table of a run")


@pytest.fixture(scope="module")
def imported(small_run: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Heavy libraries that are in after a command and those before it."""
    shards = small_run.folder / "stages" / "data" / "shards"
    run = ["run", str(small_run.recipe), "--out", str(small_run.folder)]
    made = tmp_path_factory.mktemp("made")
    commands = {
        "version": ["--version"],
        "help": ["--help"],
        "run help": ["run", "--help"],
        "convert help": ["data", "convert", "bvh", "--help"],
        "tables": ["evaluate", "--table", "list"],
        "table of a run": ["evaluate", "--table", "humantomato/7", str(small_run.folder)],
        "check": ["data", "check", str(shards)],
        "info": ["info"],
        "nothing to do": run,
        "dry run": [*run, "--dry-run"],
        "generate": [
            *("generate", str(small_run.folder), "a person waves", "-f", "npz,bvh,html"),
            *("-o", str(made / "motions")),
        ],
    }
    said = []
    for own in (slice(0, 7), slice(7, None)):  # up to the check, and what loads torch
        asked = json.dumps([HEAVY, list(commands.values())[own]])
        words = [sys.executable, "-P", "-c", PROGRAM, asked]
        said += subprocess.run(words, check=True, capture_output=True, text=True).stdout.splitlines()
    return {name: set(json.loads(line)) for name, line in zip(commands, said, strict=True)}


@pytest.mark.parametrize("command", WITHOUT)
def test_without_any_of_them(command: str, imported: dict[str, set[str]]) -> None:
    assert not imported[command]


def test_a_check_looks_for_repeated_recordings_with_scipy_alone(imported: dict[str, set[str]]) -> None:
    assert imported["check"] == {"scipy"}


@pytest.mark.parametrize("command", ["info", "nothing to do", "dry run"])
def test_with_torch_alone(command: str, imported: dict[str, set[str]]) -> None:
    assert imported[command] == {"torch"}


def test_a_model_opens_with_few_modules_of_ours() -> None:
    path = Path(__file__).resolve().parents[3] / "benchmarks" / "first_steps.py"
    assert int(runpy.run_path(str(path))["modules_to_open"]()) <= 135


@pytest.mark.parametrize("words", [["run", "nosuch"], ["run", "humantomato-tiny", "--set", "nosuch.x=1"]])
def test_a_mistake_in_the_call_is_found_without_torch(words: list[str]) -> None:
    program = PROGRAM.replace("code == 0", "code == 2")
    said = subprocess.run(
        [sys.executable, "-P", "-c", program, json.dumps([HEAVY, [words]])],
        check=True,
        capture_output=True,
        text=True,
    )
    assert json.loads(said.stdout) == []


def test_a_motion_needs_none_of_what_trains_or_loads_other_encoders(imported: dict[str, set[str]]) -> None:
    """scipy's rotations and the pictures' library come with the figure that is shown."""
    assert imported["generate"] <= {"torch", "scipy", "PIL", "huggingface_hub"}
