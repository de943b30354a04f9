"""Settings of trainings that run, and will hardly do what is meant: said before anything runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from motionloom.pipeline.contract.stage import Stage
from motionloom.pipeline.runs.recipe import Recipe
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.data import Data
from motionloom.pipeline.store.run_folder import stage_folder
from motionloom.pipeline.training.config import TrainedStageConfig


def doubts(recipe: Recipe, run: Path, stages: Iterable[Stage]) -> list[str]:
    """A sentence on each doubt about these stages of a recipe.

    How many clips there are is known where the stage that makes them is finished.
    """
    trained = [stage for stage in stages if isinstance(stage.config, TrainedStageConfig)]
    return [f"{stage.name}: {doubt}" for stage in trained for doubt in _doubts(recipe, run, stage)]


def _doubts(recipe: Recipe, run: Path, stage: Stage) -> Iterator[str]:
    yield from stage.config.doubts()
    batch, steps = stage.config.train.batch_size, stage.config.train.steps
    for name in dict.fromkeys(stage.inputs.values()):
        outside = recipe.outside.get(name)
        source = outside or recipe.stage(name)
        folder = stage_folder(run, name) if outside is None else outside.folder
        if "data" not in source.kind.gives(source.config) or Artifact.find(folder) is None:
            continue
        clips = Data(folder).clips("train")
        if 0 < clips < batch:
            yield (
                f"{name} has {clips:,} training clips and a batch {batch:,}, so each of {steps:,} steps "
                f"sees every clip {batch / clips:.1f} times; set train.batch_size"
            )
