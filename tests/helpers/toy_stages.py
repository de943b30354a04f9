"""Stage kinds for tests of what works on stages of any kind: a toy replaces or joins the registered ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from motionloom.datasets.text.encoder import EncodedText
from motionloom.pipeline.contract import stage as registry
from motionloom.pipeline.contract.stage import StageKind


def register_toys(monkeypatch: pytest.MonkeyPatch, *kinds: StageKind) -> None:
    """Put kinds into the table until the test ends, also in place of one of the same name."""
    registry.stage_kinds()  # ours are there first, or they would meet the toys' names later
    for kind in kinds:
        monkeypatch.setitem(registry.KINDS._things, kind.name, kind)


class MadeStage(StageKind):
    """A kind of a finished stage that gives an object, without any files."""

    def __init__(self, made: Any) -> None:
        self.name, self.summary = "made", "a toy"
        self.made = made

    def run(self, context: Any) -> None:
        """It has run."""
        raise AssertionError("a toy that has finished is not run")

    def load(self, *_: Any) -> Any:
        """The object."""
        return self.made

    def generator(self, *_: Any) -> Any:
        """The same object, of one that generates."""
        return self.made


class FixedEncoder:
    """Fixed random sentences of eight numbers."""

    name, dim = "fixed", 8

    def encode(self, captions: Sequence[str]) -> EncodedText:
        """Sentences by the lengths of the captions."""
        rows = [np.random.default_rng(len(c)).standard_normal(8) for c in captions]
        sentence = np.stack(rows).astype(np.float32)
        return EncodedText(sentence, sentence[:, None], np.ones((len(captions), 1), dtype=np.bool_))
