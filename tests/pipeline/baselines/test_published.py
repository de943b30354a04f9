"""The baselines' published settings: one table, which the recipes of the published sizes hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from motionloom.pipeline.contract.stage import stage_kinds
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.runs.resolve import published_settings

RECIPES = ("baselines-paper", "baselines-paper-ude")
TABLE = published_settings()


def differing(wanted: Any, found: Any, at: str = "") -> list[str]:
    """The keys of `wanted` whose values are others in `found`."""
    if isinstance(wanted, dict):
        return [key for name in wanted for key in differing(wanted[name], found.get(name), f"{at}.{name}")]
    return [] if wanted == found else [f"{at}: {wanted} published, {found} here"]


def resolved(recipe: Recipe) -> dict[str, Any]:
    return {stage.name: stage for stage in recipe.stages}


@pytest.mark.parametrize("name", RECIPES)
def test_recipes_of_the_published_sizes_hold_them(name: str) -> None:
    stages = resolved(load_recipe(name, strict=False))
    rivals = {key: stage for key, stage in stages.items() if stage.kind.name in TABLE}
    assert rivals
    for key, stage in rivals.items():
        row, ours = TABLE[stage.kind.name], TABLE[stage.kind.name].get("ours", {})
        assert not differing(row["stage"], stage.config.dump(), key)
        if "text" in row and "text" not in ours:
            assert stages[stage.inputs["text"]].config.encoder == row["text"], key
        judges = [one for one in stages.values() if one.inputs.get("generators") == [key]]
        for judge in judges if "judged" in row else []:
            assert not differing(row["judged"], judge.config.dump()["sampling"], judge.name)
        # Rows of one table are judged on as many clips.
        assert all(judge.config.clips == stages[judge.kind.name].config.clips for judge in judges)
    normed = [stage.config.net.norm for stage in stages.values() if stage.kind.name == "tma"]
    assert set(normed) == {"post"}


def test_every_baseline_has_a_row() -> None:
    folder = "motionloom.pipeline.baselines."
    kinds = [kind for kind in stage_kinds().values() if type(kind).__module__.startswith(folder)]
    trained = {kind.name for kind in kinds if kind.trains}
    assert trained == set(TABLE)


def test_what_a_recipe_says_of_the_kind_goes_before(tmp_path: Path) -> None:
    recipe = tmp_path / "mine.yaml"
    defaults = "defaults: {trained: {optim: {lr: 1}}, mdm: {train: {steps: 7}}}"
    text = f"name: mine\nextends: baselines-paper\n{defaults}\n"
    recipe.write_text(text, encoding="utf-8")
    mdm = resolved(load_recipe(recipe, strict=False))["mdm"].config.dump()
    assert (mdm["train"]["steps"], mdm["train"]["batch_size"], mdm["optim"]["lr"]) == (7, 64, 1e-4)
    recipe.write_text(text.replace("defaults: {", "defaults: {published: false, "), encoding="utf-8")
    mdm = resolved(load_recipe(recipe, strict=False))["mdm"].config.dump()
    assert (mdm["train"]["batch_size"], mdm["optim"]["lr"]) == (256, 1)
