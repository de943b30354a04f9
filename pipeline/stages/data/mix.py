"""Several data stages of a recipe as one: captioned clips beside dances, say.

Nothing is copied. The stage writes down which stages it mixes, of its run or of others, so a run that is
moved still works; data sets that no run has made become stages by `shards`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import torch
from pydantic import Field

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import SPLITS
from motionloom.datasets.check.leaks import Splits, find_leaks
from motionloom.datasets.motion.layout import MotionLayout, require_layout
from motionloom.pipeline.contract.fingerprint import RUNTIME
from motionloom.pipeline.contract.stage import (
    CompletedStage,
    Every,
    Inputs,
    Stage,
    StageConfig,
    StageContext,
    StageKind,
    register,
)
from motionloom.pipeline.store.data import MIX, Data, DataPreview, Mix, MixedStage
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.run_folder import place_from

_INPUTS = Every("data", gives="data")


class MixStageConfig(StageConfig):
    """Sampling weight of each data stage."""

    weights: dict[str, Annotated[float, Field(gt=0)]] = Field(default_factory=dict)
    """Share of the batches of a stage, by its name, relative to the others; 1 for a stage not named. One of
    another run is called after both: `other:data`."""
    allow_leaks: bool = Field(False, json_schema_extra=RUNTIME)
    """Mix data sets although a clip that one tests with is another's training clip."""


class MixStage(StageKind[MixStageConfig]):
    """Data stages, drawn by weight."""

    name = "mix"
    summary = "several data stages as one"
    config = MixStageConfig
    offers = frozenset({"data"})
    takes = (_INPUTS,)

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
        sources = context.every(_INPUTS.name)
        _one_layout({stage.name: context.stage_cache.get(stage).layout for stage in sources})
        if not context.config.allow_leaks:
            _refuse_leaks({stage.name: context.stage_cache.get(stage) for stage in sources})
        weights = context.config.weights
        # A stage of another run is named by the way to it, so that runs can be moved together.
        parts = [
            MixedStage(
                stage=stage.folder.name,
                folder=place_from(context.folder, stage.folder) if stage.outside else None,
                weight=weights.get(stage.name, 1.0),
            )
            for stage in sources
        ]
        write_json(context.folder / MIX, Mix(parts=parts).model_dump(mode="json", exclude_none=True))
        total = sum(part.weight for part in parts)
        for stage, part in zip(sources, parts, strict=True):
            data = context.stage_cache.get(stage)
            clips = len(data.split("train")) if "train" in data.splits else 0
            context.console.print(
                f"    {stage.name}: {clips} training clips, {100 * part.weight / total:.0f} % of the draws"
            )

    def preview(self, config: MixStageConfig, given: Inputs) -> DataPreview:
        return DataPreview(_one_layout({key.partition(".")[2]: given[key].layout for key in given}))

    def load(self, stage: CompletedStage, given: Inputs, device: torch.device) -> Data:
        return Data(stage.folder)


def _refuse_leaks(sources: Mapping[str, Data]) -> None:
    """`UserError` when the mix would be tested on clips that it is trained on."""
    splits: dict[str, Splits] = {
        name: {split: data.split(split) for split in SPLITS if split in data.splits}
        for name, data in sources.items()
    }
    if leaks := find_leaks(splits):
        raise UserError(
            f"{len(leaks)} clips are in two splits of a mix, such as {leaks[0]}; convert both sources "
            f"with the same split files, or set allow_leaks: true"
        )


def _one_layout(layouts: Mapping[str, MotionLayout]) -> MotionLayout:
    (first, layout), *others = layouts.items()
    for name, other in others:
        require_layout(other, layout, f"stage '{name}', mixed with '{first}'")
    return layout


register(MixStage())
