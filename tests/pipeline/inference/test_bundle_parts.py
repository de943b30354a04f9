"""Finding the generators of a run folder, also of a recipe without a face, of several, and of an old run."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.lookup import finished_stages, generators_of
from motionloom.pipeline.contract.stage import GENERATOR
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.runs.graph import make_plan
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.runs.shipped import shipped_recipes
from motionloom.pipeline.store.artifact import Artifact, InputStage


def pretend(recipe: Recipe, run: Path, stages: tuple[str, ...] | None = None) -> None:
    """The artifacts of a finished run, without anything else."""
    run.mkdir(exist_ok=True)
    (run / "recipe.yaml").write_text(recipe.to_yaml())
    for stage in recipe.stages:
        if stages is None or stage.name in stages:
            inputs = {role: InputStage(stage=name, fingerprint="0") for role, name in stage.inputs.items()}
            artifact = Artifact(
                stage=stage.name, kind=stage.kind.name, version=stage.kind.version, fingerprint="0", seed=0,
                config=stage.config.dump(), inputs=inputs,
            )  # fmt: skip
            (run / "stages" / stage.name).mkdir(parents=True)
            artifact.finish(run / "stages" / stage.name)


@pytest.mark.parametrize("name", sorted({*shipped_recipes()} - {"finetune"}))  # test_finetune.py
def test_finished_generators_are_found(name: str, tmp_path: Path) -> None:
    recipe = load_recipe(name)
    pretend(recipe, tmp_path)
    found = generators_of(tmp_path)
    makers = [s.name for s in recipe.stages if GENERATOR in s.kind.gives(s.config)]
    assert {stage.name for stage in found} == set(makers)
    if makers:
        assert found[0].name == ("ude" if name.startswith("ude") else "gpt")
    for stage in found:
        assert stage.folder == tmp_path / "stages" / stage.name
        assert stage.config == recipe.stage(stage.name).config
        above = {source.name for source in stage.upstream()}
        assert above >= set(recipe.stage(stage.name).inputs.values()) and "data" in above


def test_unfinished_ones_are_not(tmp_path: Path) -> None:
    recipe = load_recipe("bvh-body")
    pretend(recipe, tmp_path, ())
    assert finished_stages(tmp_path) == {} and generators_of(tmp_path) == []
    with pytest.raises(UserError, match="no finished stage here generates body motion; run the recipe to"):
        Bundle.from_run(tmp_path)


def test_an_input_that_has_not_finished_is_named(tmp_path: Path) -> None:
    pretend(load_recipe("bvh-body"), tmp_path, ("data", "stats", "text", "tma", "tokens", "gpt"))
    (tmp_path / "stages/gpt/model.json").write_text(
        json.dumps({"kind": "gpt", "config": {}, "layout": {"name": "body263", "fps": 20, "family": "exact"}})
    )
    with pytest.raises(UserError, match=": no finished 'tokenizer' stage here; run the recipe to"):
        Bundle.from_run(tmp_path)


SEVERAL = """
extends: humantomato-tiny
name: several
stages:
  face_vae: {kind: tma, part: face, loss: {contrastive: 0}}
  a_gpt: {kind: gpt}
"""


def test_the_recipe_says_which_comes_first(tmp_path: Path) -> None:
    """An artifact lists its inputs by name, so that the order is the recipe's, whatever has finished."""
    (tmp_path / "several.yaml").write_text(SEVERAL)
    listed = "[face_vae, a_gpt, gpt]"
    for number, (overrides, names) in enumerate(
        (
            ([], ["gpt", "face_gpt", "face_vae", "a_gpt"]),
            ([f"generate.inputs.generators={listed}"], ["face_vae", "a_gpt", "gpt", "face_gpt"]),
        )
    ):
        recipe = load_recipe(tmp_path / "several.yaml", overrides)
        trained = tuple(s.name for s in recipe.stages if s.name not in ("generate", "evaluate", "report"))
        for stages in (None, trained):
            run = tmp_path / f"{number}{stages is None}"
            pretend(recipe, run, stages)
            assert [stage.name for stage in generators_of(run)] == names
        assert load_recipe(run / "recipe.yaml") == recipe
        assert [s.inputs for s in load_recipe(run / "recipe.yaml").stages] == [
            s.inputs for s in recipe.stages
        ]


def test_a_generator_of_an_older_version_is_refused(tmp_path: Path) -> None:
    pretend(load_recipe("bvh-body"), tmp_path)
    path = tmp_path / "stages/gpt/artifact.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "version": 1}))
    with pytest.raises(UserError, match=r"made by version 1 of stage kind gpt, .* run the recipe again"):
        generators_of(tmp_path)


@pytest.fixture
def old(small_run: Any, tmp_path: Path) -> Path:
    """The run as it was when the last three stages read each model by a role of its own, in version 2."""
    run = Path(shutil.copytree(small_run.folder, tmp_path / "old"))
    recipe = yaml.safe_load((run / "recipe.yaml").read_text())
    last = ("generate", "evaluate", "report")
    models = [n for n in recipe["stages"] if n not in last and not n.endswith("tokens")]
    for name in last:
        recipe["stages"][name].pop("inputs")
        path = run / "stages" / name / "artifact.json"
        artifact = json.loads(path.read_text())
        artifact.update(version=2, fingerprint=f"of {name} then")
        artifact["inputs"] = {
            model: {
                "stage": model,
                "fingerprint": json.loads((run / "stages" / model / "artifact.json").read_text())[
                    "fingerprint"
                ],
            }
            for model in sorted(models)
        }
        path.write_text(json.dumps(artifact))
        (path.parent / "started.json").unlink()
    (run / "recipe.yaml").write_text(yaml.safe_dump(recipe, sort_keys=False))
    return run


@pytest.mark.slow
def test_a_run_of_before_opens(old: Path, small_run: Any, tmp_path: Path, call: Callable[..., Any]) -> None:
    names = [stage.name for stage in generators_of(small_run.folder)]
    assert [stage.name for stage in generators_of(old)] == names
    assert names == ["gpt", "face_gpt", "face_vae", "face_diffusion"]
    made = []
    for number, run in enumerate((old, small_run.folder)):
        out = tmp_path / f"motions{number}"
        done = call("generate", run, "a person waves", "--seconds", 1, "--seed", 4, "-f", "npz", "-o", out)
        assert done.code == 0, done.err
        with np.load(next(out.glob("*.npz"))) as stored:
            made.append({name: stored[name] for name in ("joints", "face")})
    for name, values in made[0].items():
        np.testing.assert_array_equal(values, made[1][name])
    for command in (
        ("evaluate", old),
        ("report", old),
        ("retrieval", old),
        ("export", old, "-o", tmp_path / "e"),
    ):
        done = call(*command)
        assert done.code == 0, done.err
    new = json.loads((small_run.folder / "stages/evaluate/metrics.json").read_text())
    assert json.loads((old / "evaluate/metrics.json").read_text()) == new
    plan = {row.stage.name: row for row in make_plan(load_recipe(old / "recipe.yaml"), old)}
    again = {name for name, row in plan.items() if row.action == "run"}
    assert again == {"generate", "evaluate", "report"}, "no training is lost"
    assert plan["generate"].reason == "generate v2 is now generate v5"
