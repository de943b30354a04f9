"""Stages that train on motion read it as `mode: streamed` says."""

from __future__ import annotations

from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from motionloom.pipeline.stages import diffusion, tma, tokenizer


class OpenedError(Exception):
    """The stage has opened its training clips."""


@pytest.mark.parametrize(
    ("module", "run"),
    [(tma, tma.run_tma), (diffusion, diffusion.run_diffusion), (tokenizer, tokenizer.run_tokenizer)],
)
def test_training_clips_are_opened_for_training(
    module: ModuleType, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def open_split(folder: Any, split: str, *, training: bool = False) -> None:
        raise OpenedError(split, training)

    monkeypatch.setattr(module, "open_split", open_split)
    for name in ("open_stats", "open_text"):
        if hasattr(module, name):
            monkeypatch.setattr(module, name, lambda folder: None)
    context: Any = SimpleNamespace(config=None, input=lambda role: None)
    with pytest.raises(OpenedError) as caught:
        run(context)
    assert caught.value.args == ("train", True)
