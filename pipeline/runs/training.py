"""One training of a recipe for any loop: its module, and its batches as a LightningDataModule."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from motionloom.datasets.base.errors import UserError
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import Stage, fingerprint_fields
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.training.lightning_data import StageData, open_training
from motionloom.pipeline.training.trained_stage import TrainedStage


def training(
    run_or_recipe: str | Path, stage: str, overrides: Sequence[str] = ()
) -> tuple[StageModule, StageData]:
    """Return the untrained module of a stage and its batches, as `run_recipe` would train it.

    Args:
        run_or_recipe: A run folder, whose stages that feed this one are finished; or a recipe, of which
            those that are not finished in `runs/NAME` are run first.
        stage: A stage that trains, by its name in the recipe.
        overrides: As `--set`: "tma.train.steps=2000"; of a run, of no stage that feeds this one.

    Raises:
        UserError: The stage trains nothing, or one that feeds it is not finished or is overridden.
    """
    given = Path(run_or_recipe)
    is_run = (given / "recipe.yaml").is_file()
    recipe = load_recipe(given / "recipe.yaml" if is_run else run_or_recipe, overrides)
    if is_run and overrides:
        _require_as_made(load_recipe(given / "recipe.yaml"), recipe, recipe.above(recipe.stage(stage)))
    run = given if is_run else Path("runs") / recipe.name
    opened = recipe.stage(stage)
    if not isinstance(opened.kind, TrainedStage):
        raise UserError(f"stage '{stage}' of kind {opened.kind.name} trains nothing")
    own = [name for name in opened.inputs.values() if name not in recipe.outside]
    if own and not is_run:
        run_recipe(run_or_recipe, overrides=overrides, select=Selection(until=",".join(own)))
    stages = {**recipe.outside, **(finished_stages(run) if own else {})}
    if missing := [name for name in opened.inputs.values() if name not in stages]:
        raise UserError(f"{run}: stage '{missing[0]}' is not finished; run the recipe until '{missing[0]}'")
    inputs = {role: stages[name] for role, name in opened.inputs.items()}
    seed = opened.config.train.seed_of(recipe.seed)
    return open_training(opened.kind, opened.config, inputs, seed, recipe.hardware)


def _require_as_made(made: Recipe, wanted: Recipe, stages: Sequence[Stage]) -> None:
    """Refuse overrides of finished stages, which are taken as they are."""
    for one in stages:
        if fingerprint_fields(one.config) != fingerprint_fields(made.stage(one.name, "overrides").config):
            raise UserError(
                f"overrides: the run has its stage '{one.name}' already, made as it was; leave that out, or "
                f"give the recipe"
            )
        _require_as_made(made, wanted, wanted.above(one))
