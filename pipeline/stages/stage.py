"""What a stage is: a kind (config class, input roles, a function) and the context its function gets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel
from pydantic.config import JsonDict
from rich.console import Console

from motionloom.datasets.schema import Config
from motionloom.pipeline.launch.hardware import Hardware

RUNTIME: JsonDict = {"runtime": True}
"""Marks a config field that changes how a stage runs, not what it makes: it is not fingerprinted."""


class StageConfig(Config):
    """Base of every stage's config."""

    def require_fit(self, hardware: Hardware) -> None:
        """Refuse, before anything runs, settings that cannot run on this hardware."""


@dataclass(frozen=True)
class StageContext:
    """All that a stage's function may use. `inputs` maps each role to the folder of a finished stage."""

    name: str
    recipe: str
    """Name of the recipe, for people."""
    config: Any
    folder: Path
    inputs: Mapping[str, Path]
    seed: int
    hardware: Hardware
    console: Console
    wanted_device: torch.device | None = None
    """What a command was told by `--device`."""

    @property
    def device(self) -> torch.device:
        """Where a stage computes that does not train: as told, else as the recipe's hardware says."""
        return self.wanted_device or self.hardware.device()

    def input(self, role: str) -> Path:
        """Folder of a required input."""
        return self.inputs[role]

    def optional(self, role: str) -> Path | None:
        """Folder of an input the recipe may leave out."""
        return self.inputs.get(role)


@dataclass(frozen=True)
class StageKind:
    """One line of the stage table. A role that ends in "?" is used when the recipe has it."""

    name: str
    summary: str
    config: type[StageConfig]
    run: Callable[[StageContext], None]
    inputs: tuple[str, ...] = ()
    version: int = 1
    trains: bool = False
    external: Callable[[Any], Any] | None = None
    """Facts about files outside the run (names, sizes, checksums) that belong to the fingerprint."""
    settle: Callable[[Any, Path], None] | None = None
    """Puts RUNTIME settings of the config into the folder of a finished stage, for those that read it."""


def fingerprint_fields(config: BaseModel) -> dict[str, Any]:
    """The config as plain data without the fields marked RUNTIME."""
    out: dict[str, Any] = {}
    for name, field in type(config).model_fields.items():
        extra = field.json_schema_extra
        if isinstance(extra, dict) and extra.get("runtime"):
            continue
        value = getattr(config, name)
        out[name] = fingerprint_fields(value) if isinstance(value, BaseModel) else value
    return out
