"""Captions as TMA's latents: a text stage for models that shall read words in a space aligned with motion."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.stage import (
    ALIGNMENT,
    Finished,
    Given,
    Stage,
    StageConfig,
    StageContext,
    StageKind,
)
from motionloom.pipeline.stages.same_text import same_encoder
from motionloom.pipeline.store.aligned_text import AlignedText, build_aligned_cache
from motionloom.pipeline.store.outside import is_place
from motionloom.pipeline.store.text import TextPreview


class AlignedTextConfig(StageConfig):
    """Nothing to choose: the latents are those of its TMA."""


class AlignedTextStage(StageKind):
    """TMA's latent of every caption, in the place of a text encoder's features."""

    name = "aligned_text"
    summary = "captions as TMA's latents"
    config = AlignedTextConfig
    takes = ("text", f"tma: {ALIGNMENT}")

    def gives(self, config: Any) -> frozenset[str]:
        """What every reader of captions takes."""
        return frozenset({"text"})

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:
        """The TMA must be given captions as the encoder made them that it was trained on."""
        own, tma = stage.inputs["text"], others[stage.inputs["tma"]]
        theirs = tma.inputs.get("text", own)
        if theirs != own and not (is_place(theirs) and same_encoder(theirs, own, others)):
            raise UserError(
                f"stage '{stage.name}' reads captions of '{own}' and its TMA '{tma.name}' was trained on "
                f"those of '{tma.inputs['text']}'; name that one: inputs: {{text: {tma.inputs['text']}}}"
            )

    def run(self, context: StageContext) -> None:
        """Pass the captions of all splits through TMA."""
        given = context.given
        folder, show = context.folder / "cache", context.console.is_terminal
        cache = build_aligned_cache(folder, given["text"].cache, given["tma"], show)
        context.console.print(f"    {len(cache)} different captions, {cache.dim}-d latents")

    def preview(self, config: AlignedTextConfig, given: Given) -> TextPreview:
        """The width of TMA's latents."""
        return TextPreview(given["tma"].net.config.latent)

    def load(self, stage: Finished, given: Given, device: torch.device) -> AlignedText:
        """The cache, and both encoders for new words."""
        return AlignedText(stage.folder, "", device, stage.exported, words=given["text"], tma=given["tma"])

    def exported(self, config: AlignedTextConfig) -> tuple[str, ...]:
        """What makes latents of new words."""
        return ("text", "tma")

    def export(self, stage: Finished, target: Path) -> None:
        """Nothing of its own."""
        target.mkdir(parents=True, exist_ok=True)
