"""What papers and public code say of every model of the papers' tables: recipes hold it, or say why not."""

from __future__ import annotations

from collections.abc import Iterator
from fnmatch import filter as matching
from fnmatch import fnmatch
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.contract.fingerprint import fingerprint_fields
from motionloom.pipeline.contract.stage import Stage, stage_kinds
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.runs.resolve import in_steps, published_settings
from motionloom.pipeline.store.yaml import flatten

TABLE = in_steps(published_settings(), "published")
RIVALS = {"baselines-paper": "humantomato-paper", "baselines-paper-ude": "ude-paper"}
BASES = {**RIVALS, "t2m-gpt-paper": "humantomato-paper"}
"""What a recipe extends, whose rows hold in it as well."""


@cache
def stages_of(name: str | Path) -> dict[str, Stage]:
    return {stage.name: stage for stage in load_recipe(name, strict=False).stages}


def decisive(config: Any) -> dict[str, Any]:
    """Settings by dotted key, without those that do not change what a stage makes."""
    keys = flatten(fingerprint_fields(config))
    return {key: value for key, value in flatten(config.dump()).items() if key in keys}


def departures(stage: Stage, wanted: dict[str, Any], ours: dict[str, str], whole: bool = True) -> list[str]:
    """Settings other than wanted (of the `whole` stage, than its kind's defaults) that are not `ours`."""
    own = decisive(stage.config)
    published = flatten(wanted)
    assert published.keys() <= own.keys(), (stage.name, published.keys() - own.keys())
    published = (decisive(type(stage.config)()) if whole else {}) | published
    return [
        f"{stage.name}.{key} is {value}, published {published.get(key)}"
        for key, value in own.items()
        if value != published.get(key, value if not whole else None)
        and not any(fnmatch(name, pattern) for pattern in ours for name in (key, f"{stage.name}.{key}"))
    ]


def rows_of(name: str) -> Iterator[tuple[Stage, dict[str, Any], dict[str, str]]]:
    """Stages of a recipe that have a row, with what is published of each and what is ours."""
    stages = stages_of(name)
    seen = set[str]()
    for recipe, model in product(dict.fromkeys((name, BASES.get(name, name))), TABLE.values()):
        for titles, wanted in model.get("recipes", {}).get(recipe, {}).items():
            for title in set(titles.split(", ")) - seen:
                seen.add(title)
                yield stages[title], wanted, model.get("ours", {})
    for key, stage in stages.items():
        row = TABLE.get(stage.kind.name, {})
        if "stage" in row and key not in seen:
            yield stage, row["stage"], row.get("ours", {})


RECIPES = {*BASES, *BASES.values()}


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_recipes_hold_what_is_published_or_say_what_is_ours(name: str) -> None:
    assert not [line for stage, wanted, ours in rows_of(name) for line in departures(stage, wanted, ours)]
    missing = stages_of(name).keys() - {stage.name for stage, _, _ in rows_of(name)}
    assert not [key for key in missing if stages_of(name)[key].kind.trains]


@pytest.mark.parametrize(
    "planted",
    ["mdm: {optim: {lr: 2.0e-4}}", "temos: {train: {batch_size: 64}}", "gpt: {net: {dropout: 0.2}}",
     "face_diffusion: {net: {layers: 6}}", "motiondiffuse: {net: {caption: {heads: 8}}}",
     "evaluate_face_diffusion: {sampling: {face_cfg_scale: 1.0}}", "evaluate: {repeats: 20}"],
)  # fmt: skip
def test_a_departure_without_a_reason_is_found(planted: str, tmp_path: Path) -> None:
    recipe = tmp_path / "planted.yaml"
    recipe.write_text(f"name: planted\nextends: baselines-paper\nstages: {{{planted}}}\n", encoding="utf-8")
    name = planted.partition(":")[0]
    [(wanted, ours)] = [row[1:] for row in rows_of("baselines-paper") if row[0].name == name]
    assert departures(stages_of(recipe)[name], wanted, ours)


@pytest.mark.parametrize("name", RIVALS)
def test_rivals_are_read_and_judged_as_published(name: str) -> None:
    stages = stages_of(name)
    for key, stage in stages.items():
        row = TABLE.get(stage.kind.name, {})
        ours = row.get("ours", {})
        if "text" in row and "text" not in ours:
            assert stages[stage.inputs["text"]].config.encoder == row["text"], key
        judges = [one for one in stages.values() if one.inputs.get("generators") == [key]]
        for judge in judges if "judged" in row else []:
            assert not departures(judge, {"sampling": row["judged"]}, ours, whole=False)
        # Rows of one table are judged on as many clips.
        assert all(judge.config.clips == stages[judge.kind.name].config.clips for judge in judges)
    assert stages[stages["temos"].inputs["text"]].config.encoder == TABLE["temos"]["text"]


def test_every_model_has_a_row_and_every_departure_a_reason() -> None:
    folder = "motionloom.pipeline.baselines."
    kinds = [kind for kind in stage_kinds().values() if type(kind).__module__.startswith(folder)]
    rivals = {kind.name for kind in kinds if kind.trains}
    # Thirteen models: MLD has two rows, TM2T three, Bailando three.
    assert set(TABLE) == rivals | {"humantomato", "ude", "temos", "t2m-gpt", "face_diffusion"}
    reasons = {key: reason for row in TABLE.values() for key, reason in row.get("ours", {}).items()}
    assert reasons and all(len(reason.split()) > 3 for reason in reasons.values())
    # A reason for what is as published would be read as a departure.
    for model, row in TABLE.items():
        of_model = [one for name in RECIPES for one in rows_of(name) if one[2] is row.get("ours")]
        lines = [line for stage, wanted, _ in of_model for line in departures(stage, wanted, {})]
        keys = [key for line in lines for key in (line.split()[0], line.split()[0].partition(".")[2])]
        settings = [pattern for pattern in row.get("ours", {}) if "." in pattern]
        assert all(matching(keys, pattern) for pattern in settings), model


def test_lengths_in_epochs_follow_the_clips() -> None:
    recipe = load_recipe(
        "baselines-paper", ["defaults.trained.train.clips=2560", "gpt.train.steps=7"], strict=False
    )
    steps = {stage.name: stage.config.train.steps for stage in recipe.stages if stage.kind.trains}
    assert (steps["tokenizer"], steps["gpt_apart"], steps["gpt"], steps["temos"]) == (60000, 20000, 7, 80080)
    assert (steps["mdm"], steps["mld"], steps["tma"]) == (600000, 730750, 100000)
    assert TABLE["cross_gpt"]["stage"]["optim"]["drop_at"] == [543594, 869750]
    for wrong, says in {
        "evaluator.train.epochs=5": "say steps",
        "tokenizer.train.clips=x": "need clips",
    }.items():
        with pytest.raises(UserError, match=says):
            load_recipe("baselines-paper", [wrong], strict=False)


@pytest.mark.parametrize(("published", "wanted"), [("true", (7, 64, 1e-4)), ("false", (7, 256, 1))])
def test_what_a_recipe_says_of_the_kind_goes_before(
    published: str, wanted: tuple[float, ...], tmp_path: Path
) -> None:
    recipe = tmp_path / "mine.yaml"
    defaults = f"published: {published}, trained: {{optim: {{lr: 1}}}}, mdm: {{train: {{steps: 7}}}}"
    recipe.write_text(f"name: mine\nextends: baselines-paper\ndefaults: {{{defaults}}}\n", encoding="utf-8")
    config = stages_of(recipe)["mdm"].config
    assert (config.train.steps, config.train.batch_size, config.optim.lr) == wanted
