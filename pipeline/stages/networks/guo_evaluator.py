"""The published evaluator of Guo et al. (CVPR 2022), from a folder that its user made of the release."""

from __future__ import annotations

from pathlib import Path

import torch

from motionloom.pipeline.contract.stage import (
    CompletedStage,
    Inputs,
    StageConfig,
    StageContext,
    StageKind,
    register,
)
from motionloom.pipeline.store.evaluator import LoadedEvaluator
from motionloom.pipeline.store.files import copy_files
from motionloom.pipeline.store.published_evaluator import FACTS, FILES, check_published, load_published


class GuoEvaluatorConfig(StageConfig):
    """Where the published evaluator lies."""

    folder: Path
    """A folder made by `docs/guo_evaluator.py`: weights, statistics and word vectors."""


class GuoEvaluatorStage(StageKind[GuoEvaluatorConfig]):
    """The evaluator that the papers' figures are of; it judges HumanML3D's 263 features."""

    name = "guo_evaluator"
    summary = "the published text-motion evaluator"
    config = GuoEvaluatorConfig
    offers = frozenset({"evaluator"})

    def external(self, config: GuoEvaluatorConfig) -> dict[str, str]:
        return check_published(config.folder.expanduser()).sha256

    def run(self, context: StageContext) -> None:
        """Check all of the folder and copy it, so that the run says for good what judged it."""
        source = context.config.folder.expanduser()
        load_published(source)
        copy_files(source, context.folder, (*FILES, FACTS))

    def load(self, stage: CompletedStage, given: Inputs, device: torch.device) -> LoadedEvaluator:
        return load_published(stage.folder, device)

    def export(self, stage: CompletedStage, target: Path) -> None:
        copy_files(stage.folder, target, (*FILES, FACTS))


register(GuoEvaluatorStage())
