"""Whether two text stages encode words alike, though they hold the captions of other data sets."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from motionloom.pipeline.contract.stage import CPU, Stage
from motionloom.pipeline.store.outside import in_export, is_place
from motionloom.pipeline.store.text import TextSource


def same_encoder(one: str, other: str, stages: Mapping[str, Stage]) -> bool:
    """Whether the text stages of these names are one stage, or two of one encoder; unknown ones pass."""
    if one == other or one not in stages or other not in stages:
        return True
    first, second = stages[one], stages[other]
    tma = first.inputs.get("tma") == second.inputs.get("tma")
    return first.kind.name == second.kind.name and tma and _encoder(first) == _encoder(second)


def _encoder(stage: Stage) -> Any:
    """What encodes words: the encoder that a text stage names, a folder by its place, or all that it says."""
    if is_place(stage.name) and in_export(Path(stage.name)):
        return TextSource(Path(stage.name).resolve(), "", CPU, exported=True).encoder_name
    spec = getattr(stage.config, "encoder", None)
    if not isinstance(spec, str):
        return stage.config
    folder = Path(spec).expanduser()
    return str(folder.resolve()) if folder.is_dir() else spec
