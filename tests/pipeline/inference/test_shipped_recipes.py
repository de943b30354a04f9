"""The weights of the package are what its recipes make: the same stages, settings and networks."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from safetensors import safe_open

from motionloom.datasets.audio.beat_net import WEIGHTS
from motionloom.pipeline.inference.shipped_models import shipped_models
from motionloom.pipeline.runs.api import export_run, run_recipe
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.songs.band import band_version
from motionloom.pipeline.songs.stage import put_into_package
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.yaml import dump_yaml

MODELS = shipped_models()
STEPS = 8
"""Of each training in the short form of a recipe."""
SHORT = {"synth": {"clips": 240}, "songs": {"songs": 4, "song_seconds": 24.0, "scores": []}}


def recipe_of(model: str) -> str:
    facts = json.loads((MODELS[model].folder / "card.json").read_text(encoding="utf-8"))
    return str(facts["recipe"])


def networks(folder: Path) -> dict[str, dict[str, tuple[list[int], str]]]:
    """Stage -> tensor -> shape and type, of all weights of an exported folder."""
    out: dict[str, dict[str, tuple[list[int], str]]] = {}
    for path in sorted(folder.glob("*/model.safetensors")):
        with safe_open(path, "np") as file:
            # A captioner has as many words as its clips' captions.
            names = {name: file.get_slice(name) for name in {*file.keys()} - {"word_table.weight"}}
            out[path.parent.name] = {name: (one.get_shape(), one.get_dtype()) for name, one in names.items()}
    return out


def short(recipe: Recipe, folder: Path) -> Path:
    """The recipe with few clips and steps, as a file."""
    stages: dict[str, Any] = {}
    for stage in recipe.stages:
        config = stage.config.dump()
        given: dict[str, Any] = dict(SHORT.get(stage.kind.name, {}))
        if stage.kind.name == "synth" and config.get("dances"):
            given["dances"] = {"songs": 6, "song_seconds": 10.0}
        if "train" in config:
            given["train"] = {"steps": STEPS, "validate_every": STEPS}
        if given:
            stages[stage.name] = given
    path = folder / "short.yaml"
    path.write_text(dump_yaml({
        "name": "short", "extends": recipe.name, "stages": stages,
        "hardware": {"accelerator": "cpu", "threads": 1, "convert_workers": 1},
    }))  # fmt: skip
    return path


def trained(config: Mapping[str, Any]) -> dict[str, Any]:
    """What decides on the weights: not how often a training is looked at or saved."""
    out = {key: value for key, value in config.items() if key != "train"}
    looks = {
        "validate_every",
        "checkpoint_every",
        "keep_every",
        "keep_checkpoints",
        "sample_every",
        "compile",
    }
    return out | {key: value for key, value in config.get("train", {}).items() if key not in looks}


@pytest.mark.parametrize("model", MODELS)
def test_settings_of_the_weights_are_those_of_the_recipe(model: str) -> None:
    recipe = load_recipe(recipe_of(model), strict=False)
    folders = [path.parent for path in sorted(MODELS[model].folder.glob("*/artifact.json"))]
    assert folders
    for folder in folders:
        artifact = Artifact.find(folder)
        assert artifact is not None
        stage = recipe.stage(artifact.stage)
        assert artifact.kind == stage.kind.name
        # Settings that came later have their defaults: the weights were made as these say.
        now = type(stage.config).parse(artifact.config, str(folder)).dump()
        assert trained(now) == trained(stage.config.dump()), f"{model}/{artifact.stage}"


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_the_recipe_makes_such_networks(model: str, tmp_path: Path) -> None:
    recipe = load_recipe(recipe_of(model), strict=False)
    if model == "dance":
        band_version()  # its songs are played; without the band the error says how to get it
    shipped = networks(MODELS[model].folder)
    wanted = tuple(stage.name for stage in recipe.stages if stage.name in {*shipped} | {"ude"})
    run = run_recipe(short(recipe, tmp_path), tmp_path / "run", select=Selection(until=",".join(wanted)))
    export_run(run, tmp_path / "model", half=True)
    assert networks(tmp_path / "model") == shipped


@pytest.mark.slow
def test_the_recipe_makes_such_a_beat_tracker(tmp_path: Path) -> None:
    band_version()
    run = run_recipe(short(load_recipe("ude-beats"), tmp_path), tmp_path / "run")
    put_into_package(run / "stages" / "beats", tmp_path / "beats.safetensors")
    made, shipped = (safe_open(path, "np") for path in (tmp_path / "beats.safetensors", WEIGHTS))
    assert made.metadata() == shipped.metadata()
    assert [(name, made.get_slice(name).get_shape()) for name in sorted(made.keys())] == [
        (name, shipped.get_slice(name).get_shape()) for name in sorted(shipped.keys())
    ]
