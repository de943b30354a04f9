"""docs/trainjob.yaml and docs/skypilot.yaml start our command on the machines that they ask for."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

from motionloom.pipeline.cli.main import app
from motionloom.pipeline.runs.recipe import load_recipe

DOCS = Path(__file__).resolve().parents[1] / "docs"


def example(name: str) -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load((DOCS / f"{name}.yaml").read_text())
    return data


def test_volumes_are_mounted_and_gpus_are_asked_for_in_equal_numbers() -> None:
    spec = example("trainjob")["spec"]
    template = spec["runtimePatches"][0]["trainingRuntimeSpec"]["template"]["spec"]
    pod = template["replicatedJobs"][0]["template"]["spec"]["template"]["spec"]
    mounts = {mount["name"] for mount in pod["containers"][0]["volumeMounts"]}
    assert mounts == {volume["name"] for volume in pod["volumes"]}
    asked = spec["trainer"]["resourcesPerNode"]
    gpus = {asked[kind]["nvidia.com/gpu"] for kind in ("requests", "limits")}
    assert gpus == {str(spec["trainer"]["numProcPerNode"])}


@pytest.mark.parametrize("name", ["trainjob", "skypilot"])
def test_what_it_starts_is_our_command_on_its_machines(name: str) -> None:
    data = example(name)
    words = (
        data["spec"]["trainer"]["command"]
        if name == "trainjob"
        else shlex.split(data["run"].replace("\\\n", ""))
    )
    nodes = data["spec"]["trainer"]["numNodes"] if name == "trainjob" else data["num_nodes"]
    words = words[words.index("motionloom") + 1 :]
    command: Any = typer.main.get_command(app).get_command(None, words[0])  # type: ignore[attr-defined]
    given = command.make_context("run", words[1:]).params
    hardware = load_recipe(given["recipe"], given["sets"]).hardware
    assert (hardware.nodes, hardware.devices) == (nodes, 8)
