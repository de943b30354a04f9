"""Stages that train on motion read it as `mode: streamed` says."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.contract.registry import stage_kind
from motionloom.pipeline.stages.trained import TrainedStage
from motionloom.pipeline.store.data import DataPreview

LAYOUT = MotionLayout.named("wholebody363")


class OpenedError(Exception):
    """The stage has opened its training clips."""


class Recorder(DataPreview):
    """Data that say how they are opened."""

    def split(self, name: str, *, training: bool = False) -> None:
        raise OpenedError(name, training)


@pytest.mark.parametrize(
    ("name", "options"),
    [("tma", {}), ("diffusion", {}), ("evaluator", {}), ("h2vq", {"reset_below": 0.1})],
)
def test_training_clips_are_opened_for_training(name: str, options: dict[str, Any]) -> None:
    kind = stage_kind(name, "here")
    assert isinstance(kind, TrainedStage)
    given: Any = {"data": Recorder(LAYOUT), "stats": None, "text": SimpleNamespace(dim=8, cache=None)}
    config: Any = kind.config.parse({"net": options} if options else {}, name)
    net = kind.network(kind.facts(config, given), given)
    with pytest.raises(OpenedError) as caught:
        kind.batches(config, net, given, seed=0, say=lambda line: None)
    assert caught.value.args == ("train", True)
