"""Several data stages of a recipe as one: captioned clips beside dances, say.

Nothing is copied. The stage writes down which stages it mixes, of its run or of others, so a run that is
moved still works; data sets that no run has made are mixed by `shards` (`mix:`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import torch
from pydantic import Field

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.reader import require_layout
from motionloom.pipeline.contract.stage import (
    Every,
    Finished,
    Given,
    Stage,
    StageConfig,
    StageContext,
    StageKind,
)
from motionloom.pipeline.store.data import MIX, Data, DataPreview, Mix, MixedStage
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.outside import place_from

_INPUTS = Every("data", gives="data")


class MixStageConfig(StageConfig):
    """How often each data stage is drawn."""

    weights: dict[str, Annotated[float, Field(gt=0, allow_inf_nan=False)]] = Field(default_factory=dict)
    """Share of the batches of a stage, by its name, relative to the others; 1 for a stage not named. One of
    another run is called after both: `other:data`."""


class MixStage(StageKind):
    """Data stages, drawn by weight."""

    name = "mix"
    summary = "several data stages as one"
    config = MixStageConfig
    takes = (_INPUTS,)

    def gives(self, config: MixStageConfig) -> frozenset[str]:
        """Clips."""
        return frozenset({"data"})

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:
        """There must be something to mix, no mixes among it, and weights for nothing else."""
        mixed = {key.removeprefix(f"{_INPUTS.name}."): name for key, name in stage.inputs.items()}
        sources = list(mixed)
        if not sources:
            raise UserError(f"stage '{stage.name}' mixes data stages and the recipe has no other one")
        for name in mixed.values():
            if name in others and others[name].kind.name == self.name:
                raise UserError(
                    f"stage '{stage.name}' mixes '{name}', a mix itself; list all data stages in one mix: "
                    f"inputs: {{data: [...]}}"
                )
        for name in stage.config.weights:
            if name not in sources:
                raise UserError(
                    f"stage '{stage.name}': weights.{name} is of no stage that it mixes; "
                    f"these are {', '.join(sources)}"
                )

    def run(self, context: StageContext) -> None:
        """Write the list of stages; refuse one of another layout."""
        sources = context.every(_INPUTS.name)
        _one_layout({stage.name: context.shelf.get(stage).layout for stage in sources})
        weights = context.config.weights
        parts = [_part(context, stage, weights.get(stage.name, 1.0)) for stage in sources]
        write_json(context.folder / MIX, Mix(parts=parts).model_dump(mode="json", exclude_none=True))
        total = sum(part.weight for part in parts)
        for stage, part in zip(sources, parts, strict=True):
            clips = len(context.shelf.get(stage).split("train"))
            context.console.print(
                f"    {stage.name}: {clips} training clips, {100 * part.weight / total:.0f} % of the draws"
            )

    def preview(self, config: MixStageConfig, given: Given) -> DataPreview:
        """The layout that all share."""
        return DataPreview(_one_layout({key.partition(".")[2]: given[key].layout for key in given}))

    def load(self, stage: Finished, given: Given, device: torch.device) -> Data:
        """The splits of all."""
        return Data(stage.folder)


def _part(context: StageContext, stage: Finished, weight: float) -> MixedStage:
    """A stage of the mix; one of another run by the way to it, so that runs can be moved together."""
    folder = place_from(context.folder, stage.folder) if stage.outside else None
    return MixedStage(stage=stage.folder.name, folder=folder, weight=weight)


def _one_layout(layouts: Mapping[str, MotionLayout]) -> MotionLayout:
    (first, layout), *others = layouts.items()
    for name, other in others:
        require_layout(other, layout, f"stage '{name}', mixed with '{first}'")
    return layout
