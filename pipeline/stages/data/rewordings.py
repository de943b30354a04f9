"""Other wordings of the training captions, for models that shall take more words than those."""

from __future__ import annotations

from typing import Any

import torch

from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.clips import in_order
from motionloom.datasets.text.reword import RewordConfig, Rewordings, whole_words
from motionloom.pipeline.contract.stage import (
    Finished,
    Inputs,
    StageConfig,
    StageContext,
    StageKind,
    register,
)
from motionloom.pipeline.store.data import captions_of


class RewordingsConfig(RewordConfig, StageConfig):
    """How captions are reworded [ours]; see `datasets/text/reword.py`."""


class RewordingsStage(StageKind[RewordingsConfig]):
    """Rewordings of the training captions, by the encoder of the text stage."""

    name = "rewordings"
    summary = "captions in other words"
    config = RewordingsConfig
    takes = ("data", "text")

    def run(self, context: StageContext) -> None:
        dataset, encoder = context.given["data"].split("train"), context.given["text"].encoder
        vocabulary = getattr(encoder, "vocabulary", None)
        if vocabulary is None:
            raise UserError("rewordings need an encoder of words; give this stage a 'text' stage as its text")
        captions = set[str]()
        for index in in_order(dataset, "texts.json", "face_texts.json"):
            for face in (False, True):
                captions.update(caption.text for caption in captions_of(dataset, index, face=face))
        show = context.console.is_terminal
        made = Rewordings.build(
            context.folder, captions, encoder, whole_words(vocabulary()), context.config, progress=show
        )
        context.console.print(f"    {len(made.cache)} rewordings of {len(captions)} captions")

    def load(self, stage: Finished, given: Inputs, device: torch.device) -> Any:
        return Rewordings(stage.folder)


register(RewordingsStage())
