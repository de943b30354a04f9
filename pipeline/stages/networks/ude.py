"""The UDE engine: tokens of text, music or both in turn, decoded to one motion (UDE section 3.5, 4.4).

Nothing is trained here: a `utt` stage makes tokens, a `dmd` stage decodes them, or the tokenizer's own
decoder where the recipe has none (Table 5).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.contract.generation import MotionGenerator
from motionloom.pipeline.contract.stage import (
    GENERATOR,
    CompletedStage,
    Inputs,
    Stage,
    StageContext,
    StageKind,
    register,
)
from motionloom.pipeline.inference.generators.ude import UdeConfig, UdeGenerator
from motionloom.pipeline.store.files import write_json


class UdeStage(StageKind[UdeConfig]):
    """A token model and a decoder as one generator."""

    name = "ude"
    summary = "text, music or both in turn to motion"
    config = UdeConfig
    offers = frozenset({GENERATOR})
    takes = ("utt", "dmd?")
    exports = ("utt", "dmd")

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:
        """Both halves must speak of the same tokens, and the context must leave room in a window."""
        utt = others.get(stage.inputs.get("utt", ""))
        dmd = others.get(stage.inputs.get("dmd", ""))
        if utt is None:
            return
        if dmd is not None and utt.inputs.get("tokenizer") != dmd.inputs.get("tokenizer"):
            raise UserError(
                f"stage '{stage.name}': '{utt.name}' makes tokens of '{utt.inputs.get('tokenizer')}' and "
                f"'{dmd.name}' decodes those of '{dmd.inputs.get('tokenizer')}'; name one tokenizer for both"
            )
        if stage.config.bridge_frames and not (dmd and dmd.config.net.hide):
            raise UserError(
                f"stage '{stage.name}': bridge_frames {stage.config.bridge_frames} need a diffusion decoder "
                f"that is trained to fill in; give its stage net: {{hide: 0.5}}, or set bridge_frames to 0"
            )
        window = getattr(utt.config, "max_frames", None)
        if window is not None and stage.config.context_frames >= window:
            raise UserError(
                f"stage '{stage.name}': context_frames {stage.config.context_frames} fill the window of "
                f"{window} frames that '{utt.name}' is trained on; lower them"
            )

    def run(self, context: StageContext) -> None:
        """Write the settings down; there is nothing to train."""
        write_json(context.folder / "ude.json", context.config.dump())

    def generator(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionGenerator:
        return UdeGenerator(given["utt"], given.get("dmd"), stage.config)

    def export(self, stage: CompletedStage, target: Path) -> None:
        """Its settings are in the list of stages."""
        target.mkdir(parents=True, exist_ok=True)


register(UdeStage())
