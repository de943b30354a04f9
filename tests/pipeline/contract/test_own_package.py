"""A package of one's own (`docs/example`), from outside the tree, through the whole program."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from own_package import EXAMPLE, installed, program, python, takes

from motionloom.datasets.base.records import Manifest
from motionloom.pipeline.store.training_log import read_training_log

pytestmark = pytest.mark.slow

STEPS = 30
SMALL = [
    *("hardware.accelerator=cpu", "hardware.devices=1", "hardware.threads=1", "hardware.workers=1"),
    *("hardware.loggers=[]", "tma.net={latent: 16, layers: 1, heads: 2, ff: 16}", "sway.net.width=8"),
    *(f"{stage}.train={{steps: {STEPS}, batch_size: 8, checkpoint_every: 10, validate_every: 10}}"
      for stage in ("tma", "sway")),
    *("generate.count=2", "evaluate.clips=4", "evaluate.repeats=1", "report.count=1"),
]  # fmt: skip


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return installed(tmp_path_factory.mktemp("site"))


@pytest.fixture(scope="module")
def source(site: Path) -> Path:
    return takes(site / "takes")


@pytest.fixture(scope="module")
def command(site: Path, source: Path) -> list[object]:
    """The run of the example's recipe, small."""
    options = [word for one in (f"data.source={source}", *SMALL) for word in ("--set", one)]
    return ["run", EXAMPLE / "sway.yaml", "--out", site / "run", *options]


@pytest.fixture(scope="module")
def run(site: Path, command: list[object]) -> Path:
    said = program(site, *command)
    assert f"step {STEPS}/{STEPS}" in said
    return site / "run"


@pytest.fixture(scope="module")
def export(site: Path, run: Path) -> Path:
    program(site, "export", run, "-o", site / "exported")
    return site / "exported"


def test_it_is_as_short_as_it_says() -> None:
    lines = sum(len(path.read_text().splitlines()) for path in EXAMPLE.glob("sway/*.py"))
    assert f"{lines} lines" in (EXAMPLE / "README.md").read_text()


def test_the_command_line_knows_the_converter_and_the_format(site: Path, source: Path) -> None:
    assert "Joints in NumPy files" in program(site, "data", "convert", "arrays", "--help")
    assert "csv (joints as text)" in re.sub(r"[\s│]+", " ", program(site, "generate", "--help"))
    plan = program(site, "data", "convert", "arrays", source, site / "none", "--plan")
    assert "found in the source 20 " in re.sub(r"[\s│]+", " ", plan) and not (site / "none").exists()
    program(site, "data", "convert", "arrays", source, site / "shards", "--workers", 2, "-s", "size=1.05")
    made = Manifest.load_json(site / "shards/manifest.json")
    assert (made.converter, made.options["size"]) == ("arrays", 1.05)
    assert {shard.split: shard.samples for shard in made.shards} == {"train": 15, "test": 5}


def test_it_is_planned_and_counted(site: Path, command: list[object]) -> None:
    said = program(site, *command, "--sizes", "--out", site / "nothing")
    row = re.search(r"│ sway +│ ([\d.]+) k +│ 8 +│ 30 +│", said)
    # A sentence of 384 numbers, 4 of noise and 8 waves to 8, and those to 133 columns, with biases.
    assert row and float(row[1]) == pytest.approx(((384 + 4 + 8) * 8 + 8 + 8 * 133 + 133) / 1e3, abs=0.1)
    assert re.search(r"│ sway +│ sway +│ run +│[^│]+│ data, stats, text", said)
    assert not (site / "nothing").exists()


def test_its_losses_metric_and_format_come_out(run: Path) -> None:
    assert {"train/place", "val/speed"} <= {
        key for row in read_training_log(run / "stages/sway") for key in row
    }
    assert {"train/tight", "train/contrastive"} <= set(read_training_log(run / "stages/tma")[0])
    assert "sway: place" in (run / "stages/report/report.html").read_text()
    metrics = json.loads((run / "stages/evaluate/metrics.json").read_text())
    assert "sway.reach" in {figure["name"] for figure in metrics["figures"]}
    assert metrics["about"]["judges"]["tma"]["kind"] == "tight_tma", "a subclass stands in its base's role"
    assert [
        np.loadtxt(path, delimiter=",").shape[1] for path in run.glob("stages/generate/motions/*.csv")
    ] == [66] * 2


def test_a_name_on_the_hub_generates(site: Path, run: Path, export: Path) -> None:
    facts = json.loads((export / "bundle.json").read_text())
    assert facts["packages"] == ["sway==0.1.0"] and facts["generators"] == ["sway"]
    repository = site / "hf/hub/models--me--sway"
    shutil.copytree(export, repository / "snapshots/1234")
    (repository / "refs").mkdir()
    (repository / "refs/main").write_text("1234")
    offline = {"HF_HOME": site / "hf", "HF_HUB_OFFLINE": 1}
    made = {}
    for model in ("me/sway", run):
        out = site / f"made-{Path(model).name}"
        given = ("a person sways widely", "--seconds", 2, "--format", "npz,csv", "--out", out)
        program(site, "generate", model, *given, **offline)
        (file,) = out.glob("*.npz")
        made[model] = np.load(file)["features"]
    assert made[run].shape == (40, 133)
    np.testing.assert_array_equal(made["me/sway"], made[run])
    said = program(site, "generate", "me/other", "a person sways", code=2, **offline)
    assert said.startswith("error: me/other: no such folder") and len(said.splitlines()) == 1
    assert "comes with motionloom" in said and "hub" in said


def test_without_the_package_its_name_is_said(run: Path, export: Path) -> None:
    said = program(None, "generate", export, "a person sways", code=2)
    assert "'sway'" in said and "sway==0.1.0" in said and "MOTIONLOOM_STAGES" in said
    said = program(None, "run", run / "recipe.yaml", code=2)
    assert "stages.data.kind = 'arrays'" in said and len(said.splitlines()) == 1


def test_a_changed_loss_is_a_reason(site: Path, command: list[object], run: Path) -> None:
    assert "nothing to do" in program(site, *command)
    losses = site / "sway/losses.py"
    text = losses.read_text()
    losses.write_text(text.replace("0.5 * speed", "0.6 * speed"))
    said = program(site, *command, "--dry-run", COLUMNS=200)
    losses.write_text(text)
    plan = [re.sub(r" +", " ", line) for line in said.splitlines()]
    for name, why in (
        *((name, "skip │ finished") for name in ("data", "stats", "text")),
        *((name, "run │ code of sway.losses changed") for name in ("tma", "sway")),
        ("generate", "run │ input sway changed"),
        ("evaluate", "run │ input tma changed"),
    ):
        assert any(line.startswith(f"│ {name} │") and why in line for line in plan), name
    assert "nothing to do" in program(site, *command)


REFUSED = """
from motionloom.datasets.base.errors import UserError
from motionloom import register
from sway import converter, extras, stages

from motionloom.datasets.convert.registry import names
from motionloom.pipeline.contract.stage import stage_kinds

assert {"sway", "tight_tma", "arrays", "pulse"} <= set(stage_kinds())
assert register(converter.Arrays) is converter.Arrays and "arrays" in names()  # the same once more
column = extras.Metric("sway.reach", "the same once more")
for wrong in (
    stages.SwayStage(),
    type("Bvh", (converter.Arrays,), {"name": "bvh"}),
    extras.Pulse(),
    extras.ClipMetric("Mine", extras.reach, (column,)),
    extras.Writer("csv", "_mine.csv", "text/csv", "", extras.write_csv),
    3,
    stages.SwayStage,
    converter.Arrays(None),
):
    try:
        register(wrong)
    except UserError as error:
        print(error)
"""


def test_what_cannot_be_added_is_refused(site: Path) -> None:
    said = python(site, REFUSED).splitlines()
    assert [line.partition(":")[0] for line in said] == [
        "stage kind 'sway'", "converter 'bvh'", "modality 'pulse'", "clip metric 'Mine'", "writer 'csv'",
        *["register"] * 3,
    ]  # fmt: skip
