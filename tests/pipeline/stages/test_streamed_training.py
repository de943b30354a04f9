"""Stages that train on motion read it as `mode: streamed` says."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.contract.stage import stage_kind
from motionloom.pipeline.store.data import DataPreview
from motionloom.pipeline.training.trained_stage import TrainedStage

LAYOUT = MotionLayout.named("wholebody363")


class OpenedError(Exception):
    """The stage has opened its training clips."""


class Recorder(DataPreview):
    """Data that say how they are opened."""

    def split(self, name: str, *, training: bool = False) -> None:
        raise OpenedError(name, training)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("tma", {}),
        ("mdm", {}),
        ("inbetween", {}),
        ("evaluator", {}),
        ("h2vq", {"reset_below": 0.1}),
        ("motiondiffuse", {"dim": 16, "layers": 1}),
    ],
)
def test_training_clips_are_opened_for_training(name: str, options: dict[str, Any]) -> None:
    kind = stage_kind(name, "here")
    assert isinstance(kind, TrainedStage)
    there = {"data": Recorder(LAYOUT), "stats": None, "text": SimpleNamespace(dim=8, cache=None)}
    inputs = kind.inputs({role: partial(there.get, role) for role in there})
    config: Any = kind.config.parse({"net": options} if options else {}, name)
    net = kind.network(kind.facts(config, inputs), inputs)
    with pytest.raises(OpenedError) as caught:
        kind.batches(config, net, inputs, seed=0, log=lambda line: None)
    assert caught.value.args == ("train", True)
