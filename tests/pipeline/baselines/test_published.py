"""What papers and public code say of every model of the papers' tables: recipes hold it, or say why not."""

from __future__ import annotations

from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest

from motionloom.pipeline.contract.stage import stage_kinds
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.runs.resolve import published_settings

TABLE = published_settings()
MODELS = {
    *("humantomato", "ude", "temos", "t2m-gpt", "face_diffusion", "mdm", "motiondiffuse", "motion_vae"),
    *("latent_diffusion", "motionclip", "tm2t", "captioner", "seq2seq", "fact"),
    *("dance_vq", "cross_gpt", "actor_critic"),
}
"""Thirteen models: MLD has two rows, TM2T three, Bailando three."""


def leaves(tree: dict[str, Any], at: str) -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{at}.{name}")
        else:
            yield f"{at}.{name}", value


def setting(config: dict[str, Any], key: str) -> Any:
    found: Any = config
    for part in key.split(".")[1:]:
        found = found.get(part) if isinstance(found, dict) else None
    return list(found) if isinstance(found, tuple) else found


def departures(name: str, stage: str, wanted: dict[str, Any], ours: dict[str, str]) -> list[str]:
    """Settings of a stage that are others than wanted, and that `ours` does not name."""
    [opened] = [one for one in load_recipe(name, strict=False).stages if one.name == stage]
    config = opened.config.dump()
    return [
        f"{name}: {key} is {setting(config, key)}, published {value}"
        for key, value in leaves(wanted, stage)
        if setting(config, key) != value and not any(fnmatch(key, pattern) for pattern in ours)
    ]


@pytest.mark.parametrize("model", [model for model, row in TABLE.items() if "recipes" in row])
def test_models_of_the_papers_own_kinds_hold_their_settings(model: str) -> None:
    row = TABLE[model]
    for name, stages in row["recipes"].items():
        for stage, wanted in stages.items():
            assert not departures(name, stage, wanted, row.get("ours", {}))


@pytest.mark.parametrize("name", ["baselines-paper", "baselines-paper-ude"])
def test_rivals_hold_their_settings(name: str) -> None:
    stages = {stage.name: stage for stage in load_recipe(name, strict=False).stages}
    rivals = {key: stage for key, stage in stages.items() if "stage" in TABLE.get(stage.kind.name, {})}
    assert rivals
    for key, stage in rivals.items():
        row = TABLE[stage.kind.name]
        ours = row.get("ours", {})
        assert not departures(name, key, row["stage"], ours)
        if "text" in row and "text" not in ours:
            assert stages[stage.inputs["text"]].config.encoder == row["text"], key
        judges = [one for one in stages.values() if one.inputs.get("generators") == [key]]
        for judge in judges if "judged" in row else []:
            assert not departures(name, judge.name, {"sampling": row["judged"]}, ours)
        # Rows of one table are judged on as many clips.
        assert all(judge.config.clips == stages[judge.kind.name].config.clips for judge in judges)
    temos = stages["temos"]
    assert stages[temos.inputs["text"]].config.encoder == TABLE["temos"]["text"]


def test_every_model_has_a_row_and_every_departure_a_reason() -> None:
    folder = "motionloom.pipeline.baselines."
    kinds = [kind for kind in stage_kinds().values() if type(kind).__module__.startswith(folder)]
    assert {kind.name for kind in kinds if kind.trains} < set(TABLE) == MODELS
    reasons = [reason for row in TABLE.values() for reason in row.get("ours", {}).values()]
    assert reasons and all(len(reason.split()) > 3 for reason in reasons)


def test_lengths_in_epochs_are_steps() -> None:
    gpt = TABLE["cross_gpt"]["stage"]
    per_epoch = 69580 / 32
    assert gpt["train"] == {"steps": round(500 * per_epoch), "batch_size": 32, "precision": "32-true"}
    assert gpt["optim"]["drop_at"] == [round(250 * per_epoch), round(400 * per_epoch)]


def test_what_a_recipe_says_of_the_kind_goes_before(tmp_path: Path) -> None:
    recipe = tmp_path / "mine.yaml"
    defaults = "defaults: {trained: {optim: {lr: 1}}, mdm: {train: {steps: 7}}}"
    text = f"name: mine\nextends: baselines-paper\n{defaults}\n"

    def mdm() -> dict[str, Any]:
        recipe.write_text(text, encoding="utf-8")
        [stage] = [one for one in load_recipe(recipe, strict=False).stages if one.name == "mdm"]
        return stage.config.dump()

    made = mdm()
    assert (made["train"]["steps"], made["train"]["batch_size"], made["optim"]["lr"]) == (7, 64, 1e-4)
    text = text.replace("defaults: {", "defaults: {published: false, ")
    made = mdm()
    assert (made["train"]["batch_size"], made["optim"]["lr"]) == (256, 1)
