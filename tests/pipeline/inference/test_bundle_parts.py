"""Finding the parts of a model in a run folder, also of a recipe without a face line."""

from __future__ import annotations

from pathlib import Path

import pytest

from motionloom.pipeline.inference.bundle import PARTS, part_folders
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.runs.shipped import shipped_recipes


@pytest.mark.parametrize("name", sorted(shipped_recipes()))
def test_finished_parts_are_found(name: str, tmp_path: Path) -> None:
    recipe = load_recipe(name)
    (tmp_path / "recipe.yaml").write_text(recipe.to_yaml())
    for stage in recipe.stages:
        (tmp_path / "stages" / stage.name).mkdir(parents=True)
        (tmp_path / "stages" / stage.name / "artifact.json").write_text("{}")
    found = part_folders(tmp_path)
    assert set(found) == set(PARTS) & {stage.name for stage in recipe.stages}
    assert {"stats", "tokenizer", "gpt"} <= set(found)
    assert all(folder == tmp_path / "stages" / role for role, folder in found.items())


def test_unfinished_parts_are_not(tmp_path: Path) -> None:
    (tmp_path / "recipe.yaml").write_text(load_recipe("bvh-body").to_yaml())
    assert part_folders(tmp_path) == {}
