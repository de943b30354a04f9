"""One training of a recipe for any Trainer: its module and batches, and the finished stage of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from motionloom.datasets.base.errors import UserError
from motionloom.models.training.distributed import rank
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.contract.fingerprint import fingerprint_fields
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import Stage, StageCache
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.execute import finish_stage, stage_inputs
from motionloom.pipeline.runs.plan import Selection, make_plan
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.store.run_folder import identity_of, stage_folder
from motionloom.pipeline.store.weights import save_model
from motionloom.pipeline.training.lightning_data import open_training
from motionloom.pipeline.training.loaders import StageData
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


def finish(module: StageModule, run: str | Path, stage: str) -> Path:
    """Write what a Trainer has trained as a finished stage of a run; returns the stage's folder.

    Later stages train on it, and `generate`, `evaluate` and `export` take it, as if `motionloom run` had
    trained it. `artifact.json` names the Trainer. In processes other than the first nothing is written.

    Args:
        module: As `training` gave it and a Trainer trained it, or `load_from_checkpoint` brought it back.
        run: A run folder, in which the stages that feed this one are finished.
        stage: The stage's name in the run's recipe.

    Raises:
        UserError: The module was trained with other settings or inputs than the run has, or the stage has
            begun or is finished there already.
    """
    folder = Path(run)
    hyper = dict(module.hparams)
    if not {"kind", "config", "inputs", "identities"} <= hyper.keys():
        raise UserError(
            f"finish: the module has no settings of a stage; train the one of training({stage!r})"
        )
    recipe = load_recipe(folder / "recipe.yaml")
    opened = recipe.stage(stage)
    kind = opened.kind
    plan = make_plan(recipe, folder)
    row = next(row for row in plan if row.stage.name == stage)
    place = stage_folder(folder, stage)
    if not isinstance(kind, TrainedStage) or hyper["kind"] != kind.name:
        raise UserError(f"{place}: a stage of kind {kind.name}, and the module is of kind {hyper['kind']}")
    trained = kind.config.parse(dict(hyper["config"]), "the module's config")
    if key := _first_difference(fingerprint_fields(trained), fingerprint_fields(opened.config)):
        raise UserError(
            f"{folder / 'recipe.yaml'}: '{stage}' has another {key} than the module was trained with; give "
            f"both the same"
        )
    if row.action != "run" or place.exists():
        raise UserError(f"{place}: the stage has begun there, or is finished; take another run folder")
    inputs = stage_inputs(recipe, folder, opened)
    for role, source in inputs.items():
        if not source.folder.exists() or identity_of(source.folder) != hyper["identities"][role]:
            raise UserError(
                f"{source.folder}: is not what the module was trained on as '{role}'; train it on this run"
            )
    if rank() == 0:
        facts = kind.facts(opened.config, kind.inputs.of(StageCache().given(inputs)))
        by = f"lightning.Trainer, {module.step} steps"
        finish_stage(recipe, folder, plan, row, lambda home: save_model(home, module.net, facts), by)
    return place


def _first_difference(one: object, other: object, key: str = "") -> str:
    """The dotted key of the first value that differs; "" if none does."""
    if not isinstance(one, dict) or not isinstance(other, dict):
        return "" if one == other else key.lstrip(".")
    keys = dict.fromkeys([*one, *other])
    found = (_first_difference(one.get(name), other.get(name), f"{key}.{name}") for name in keys)
    return next(filter(None, found), "")


def _require_as_made(made: Recipe, wanted: Recipe, stages: Sequence[Stage]) -> None:
    """Refuse overrides of finished stages, which are taken as they are."""
    for one in stages:
        if fingerprint_fields(one.config) != fingerprint_fields(made.stage(one.name, "overrides").config):
            raise UserError(
                f"overrides: the run has its stage '{one.name}' already, made as it was; leave that out, or "
                f"give the recipe"
            )
        _require_as_made(made, wanted, wanted.above(one))
