"""A baseline from one folder outside the package (`tests/helpers/pacer/`), through the whole program.

Nothing but that folder and a recipe: the installed program is started with `MOTIONLOOM_STAGES=pacer.stage`.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.register import VARIABLE
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract import stage as registry
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.runs.recipe import recipe_schema
from motionloom.pipeline.store.training_log import read_training_log

pytestmark = pytest.mark.slow

HELPERS = Path(__file__).resolve().parents[2] / "helpers"
PROGRAM = Path(sysconfig.get_path("scripts")) / "motionloom"
STEPS = 120
RECIPE = f"""
name: pacer-small
seed: 5
hardware: {{accelerator: cpu, devices: 1, threads: 1, convert_workers: 1, loggers: []}}
stages:
  data:
    kind: synth
    layout: body133
    clips: 12
    max_seconds: 5.0
    test_fraction: 0.25
    dances: {{songs: 4, song_seconds: 6.0, share: 1.0, conditions: {{audio: 1.0, both: 0.0}}}}
  stats: {{kind: stats}}
  audio: {{kind: audio}}
  pacer:
    kind: pacer
    net: {{width: 8}}
    train: {{steps: {STEPS}, batch_size: 8, checkpoint_every: 10, validate_every: 20, ema: 0.9}}
  generate: {{kind: generate, dances: 1, dance_seconds: 2, formats: [npz]}}
  evaluate_dances: {{kind: evaluate_dances, clips: 2, repeats: 1, shuffles: 1, pool: 4}}
  report: {{kind: report, count: 1}}
"""


def environment(stages: str | None = "pacer.stage") -> dict[str, str]:
    """Of the program: helpers on Python's path, and the module that registers the kind."""
    path = os.pathsep.join(filter(None, (str(HELPERS), os.environ.get("PYTHONPATH"))))
    given = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "COLUMNS": "140"}
    given.pop(VARIABLE, None)
    return given if stages is None else {**given, VARIABLE: stages}


def start(*arguments: object, stages: str | None = "pacer.stage") -> subprocess.Popen[str]:
    return subprocess.Popen(
        [str(PROGRAM), *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment(stages),
        start_new_session=True,
    )


def program(*arguments: object, code: int = 0, stages: str | None = "pacer.stage") -> str:
    process = start(*arguments, stages=stages)
    output, _ = process.communicate(timeout=240)
    assert process.returncode == code, output
    return output


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pacer") / "pacer-small.yaml"
    path.write_text(RECIPE)
    return path


@pytest.fixture(scope="module")
def run(recipe: Path) -> Path:
    """An undisturbed run."""
    folder = recipe.parent / "run"
    output = program("run", recipe, "--out", folder)
    assert "[4/7] pacer (" in output and f"step {STEPS}/{STEPS}" in output
    return folder


@pytest.fixture(scope="module")
def export(run: Path) -> Path:
    """What the run exports."""
    folder = run.parent / "exported"
    program("export", run, "-o", folder)
    return folder


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The kind in this process, for one test."""
    registry.stage_kinds()
    monkeypatch.delitem(sys.modules, "pacer.stage", raising=False)
    importlib.import_module("pacer.stage")
    yield
    del sys.modules["pacer.stage"], registry.KINDS["pacer"]


def test_dry_run_counts_it_without_data(recipe: Path) -> None:
    output = program("run", recipe, "--out", recipe.parent / "nothing", "--dry-run")
    row = re.search(r"│ pacer +│ ([\d.]+) k +│ 8 +│ 120 +│[^│]+│ ([\d.]+) MiB +│[^│]+│ 32 frames +│", output)
    assert row, output
    # Two convolutions over 9 frames and one over 1, with biases: 438 features and 4 of noise to 133 columns.
    assert float(row[1]) == pytest.approx(
        ((438 + 4) * 9 * 8 + 8 + 8 * 9 * 8 + 8 + 8 * 133 + 133) / 1e3, abs=0.1
    )
    # Weights, gradients and moments of the generator and of the critic, and more for the backward pass.
    critic = (438 + 133) * 9 * 8 + 8 + 8 * 9 * 8 + 8 + 8 + 1
    assert float(row[2]) > 16 * (1e3 * float(row[1]) + critic) / 2**20
    assert re.search(r"│ pacer +│ pacer +│ run +│[^│]+│ data, stats, audio", output)
    assert not (recipe.parent / "nothing").exists()


def test_its_curves_are_in_the_report(run: Path) -> None:
    page = (run / "stages/report/report.html").read_text()
    assert "margin of the critic" in page and "pacer: pacer distance" in page
    rows = read_training_log(run / "stages/pacer")
    assert {"train/critic_margin", "train/pacer_distance"} <= set(rows[0])
    assert {row["step"] for row in rows if "val/critic_margin" in row} == {*range(20, STEPS + 1, 20)}


def test_export_loads_and_generates(run: Path, export: Path, known: None, tmp_path: Path) -> None:
    facts = json.loads((export / "bundle.json").read_text())
    assert facts["generators"] == ["pacer"]
    assert {path.parent.name for path in export.glob("*/artifact.json")} == {"stats", "audio", "pacer"}
    alone = shutil.move(export, tmp_path / "alone")  # nothing beside it is looked at
    noise = np.random.default_rng(0).standard_normal(3 * 16_000).astype(np.float32)
    songs = [Sound(0.1 * np.clip(noise, -5, 5) * np.sin(np.pi * np.arange(len(noise)) / 8000) ** 8, 16_000)]
    songs.append(songs[0].slice(0, 2))
    model = Bundle.open(alone)
    made = model.generate(sounds=songs, seed=1)
    assert [m.features.shape for m in made] == [(60, 133), (40, 133)]
    assert [m.joints.shape for m in made] == [(60, 22, 3), (40, 22, 3)]
    of_run = Bundle.open(run).generate(sounds=songs, seed=1)
    for one, two in zip(made, of_run, strict=True):
        np.testing.assert_array_equal(one.features, two.features)
    again = model.generate(sounds=songs[:1], seed=2)[0]
    assert not np.array_equal(again.features, made[0].features)
    (shorter,) = model.generate(sounds=songs[1:], seconds=1, seed=1)
    assert shorter.features.shape == (20, 133)
    with pytest.raises(UserError, match=r"text.* audio only"):
        model.generate(["a person waves"])
    shutil.move(alone, export)


def test_released_weights_are_read_under_their_names(recipe: Path, run: Path) -> None:
    trained = load_file(run / "stages/pacer/model.safetensors")
    theirs = {f"generator.{name}": value for name, value in trained.items()}
    save_file(theirs | {"critic.0.bias": np.zeros(8, np.float32)}, recipe.parent / "released.safetensors")
    folder, weights = recipe.parent / "published", recipe.parent / "released.safetensors"
    program("run", recipe, "--out", folder, "--until", "pacer", "--set", f"pacer.published={weights}")
    loaded = load_file(folder / "stages/pacer/model.safetensors")
    assert loaded.keys() == trained.keys()
    assert all(np.array_equal(loaded[name], value) for name, value in trained.items())


def test_the_recipe_schema_has_it(known: None) -> None:
    stages = recipe_schema()["properties"]["stages"]["additionalProperties"]["anyOf"][0]
    assert "pacer" in stages["properties"]["kind"]["enum"]
    (branch,) = (b["then"] for b in stages["allOf"] if b["if"]["properties"]["kind"]["const"] == "pacer")
    assert {"critic", "adversarial", "window"} <= set(branch["properties"])
    assert set(branch["properties"]["inputs"]["properties"]) == {"data", "stats", "audio"}


def test_without_the_module_it_is_one_sentence(recipe: Path, run: Path, export: Path) -> None:
    said = program("run", recipe, "--out", recipe.parent / "other", code=2, stages=None)
    assert "stages.pacer.kind = 'pacer'" in said and VARIABLE in said
    assert said.startswith("error: ") and len(said.splitlines()) == 1
    assert "pacer" not in registry.stage_kinds()
    for folder in (run, export):
        with pytest.raises(UserError, match=f"'pacer' .*{VARIABLE}"):
            Bundle.open(folder)
    said = program("run", recipe, "--dry-run", code=2, stages="pacer.stage, no_such_module")
    assert "MOTIONLOOM_STAGES=no_such_module: cannot be imported" in said and len(said.splitlines()) == 1


def test_a_second_kind_of_one_name_is_refused(known: None) -> None:
    kind = registry.stage_kind("pacer", "here")
    assert registry.register(kind) is kind
    with pytest.raises(UserError, match=r"two .*'pacer'"):
        registry.register(type(kind)())
