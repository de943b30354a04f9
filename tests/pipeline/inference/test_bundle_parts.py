"""Finding the generators of a run folder, also of a recipe without a face, of several, and of an old run."""

from __future__ import annotations

from pathlib import Path

import pytest

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.contract.lookup import finished_stages, generators_of
from motionloom.pipeline.contract.stage import GENERATOR
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.runs.layers import shipped_recipes
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
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


# Those that start from a model of the package need its weights: test_finetune.py.
@pytest.mark.parametrize("name", sorted({*shipped_recipes()} - {"finetune"}))
def test_finished_generators_are_found(name: str, tmp_path: Path) -> None:
    recipe = load_recipe(name)
    pretend(recipe, tmp_path)
    found = generators_of(tmp_path)
    makers = [s.name for s in recipe.stages if GENERATOR in s.kind.gives(s.config)]
    readers = [s.inputs for s in recipe.stages if s.name not in makers]
    read = {given for one in readers for role, given in one.items() if role.startswith("generators.")}
    begun = {s.inputs.get("start") for s in recipe.stages if s.name in makers} - read
    makers = [name for name in makers if name not in begun]
    assert {stage.name for stage in found} == set(makers)
    if makers:
        first = "ude" if "ude" in makers else "gpt"
        assert found[0].name == (first if first in makers else makers[0])
    for stage in found:
        assert stage.folder == tmp_path / "stages" / stage.name
        assert stage.config == recipe.stage(stage.name).config
        above = {source.name for source in stage.upstream()}
        assert above >= set(recipe.stage(stage.name).inputs.values()) and "data" in above


def test_unfinished_ones_are_not(tmp_path: Path) -> None:
    recipe = load_recipe("bvh-body")
    pretend(recipe, tmp_path, ())
    assert finished_stages(tmp_path) == {} and generators_of(tmp_path) == []
    with pytest.raises(UserError, match="generates body motion"):
        Bundle.from_run(tmp_path)


def test_the_recipe_says_which_comes_first(tmp_path: Path) -> None:
    """An artifact lists its inputs by name, so that the order is the recipe's, whatever has finished."""
    more = "{face_vae: {kind: tma, part: face, loss: {contrastive: 0}}, a_gpt: {kind: gpt}}"
    (tmp_path / "several.yaml").write_text(f"{{extends: humantomato-tiny, name: several, stages: {more}}}")
    listed = "generate.inputs.generators=[face_vae, a_gpt, gpt]"
    ways = (
        ([], ["gpt", "face_gpt", "face_vae", "a_gpt"]),
        ([listed], ["face_vae", "a_gpt", "gpt", "face_gpt"]),
    )
    for number, (overrides, names) in enumerate(ways):
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
