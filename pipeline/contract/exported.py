"""An exported folder, read: the stages that generation needs, each in a folder of its own, and `bundle.json`.

It may come from anywhere, so nothing outside it is ever followed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field

from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.contract.registry import stage_kind
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import GENERATOR, Finished, Role
from motionloom.pipeline.store.outside import BUNDLE_FILE
from motionloom.pipeline.store.weights import LayoutFacts

FORMAT = 2

_NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]*$"


class ExportedStage(Config):
    """One stage of an export."""

    kind: str
    version: int
    config: dict[str, Any]
    inputs: dict[str, str]
    """Role -> name of another stage of the export."""
    sha256: dict[str, str] = Field(default_factory=dict)
    """File of weights -> its sha256; what stands here is compared when the stage is opened."""


class BundleFile(Config):
    """`bundle.json`."""

    format: int
    layout: LayoutFacts
    generators: tuple[str, ...]
    """Stages that generate, the default first."""
    stages: dict[str, ExportedStage] = Field(default_factory=dict)
    sampling: dict[str, Any] = Field(default_factory=dict)
    """Fields of `SamplingConfig` that its motions are best drawn with, where nobody says otherwise."""


def open_exported(folder: Path) -> list[Finished]:
    """The stages of an export that generate, the default first."""
    path, facts, made = folder / BUNDLE_FILE, _read(folder), dict[str, Finished]()
    makers = [_build(folder, facts, name, (), made) for name in facts.generators]
    for stage in makers:
        if not stage.gives(GENERATOR):
            raise UserError(
                f"{path}: its stage '{stage.name}' of kind {stage.kind.name} generates nothing; export the "
                f"run again"
            )
    return makers


def exported_sampling(folder: Path) -> SamplingConfig:
    """How an export's motions are best drawn; fields of which it says nothing are not set."""
    return SamplingConfig.parse(_read(folder).sampling, f"{folder / BUNDLE_FILE}: sampling")


def exported_stage(folder: Path) -> Finished:
    """One stage of an export, by its folder, which must be there."""
    return _build(folder.parent, _read(folder.parent), folder.name, (), {})


def _read(folder: Path) -> BundleFile:
    path = folder / BUNDLE_FILE
    if _format_of(path) != FORMAT:
        raise UserError(
            f"{path}: exported by another version of motionloom; export the run again: motionloom export RUN"
        )
    return BundleFile.load_json(path)


def _build(
    folder: Path, facts: BundleFile, name: str, above: tuple[str, ...], made: dict[str, Finished]
) -> Finished:
    """A stage and those it needs, each once."""
    path = folder / BUNDLE_FILE
    if name in above:
        raise UserError(f"{path}: stage '{name}' needs itself; export the run again")
    if name in made:
        return made[name]
    entry = facts.stages.get(name)
    if entry is None or not _is_name(name) or not (folder / name).is_dir():
        raise UserError(
            f"{path}: its stage '{name}' is not here; copy the whole folder, or export the run again"
        )
    kind = stage_kind(entry.kind, f"{path}: stages.{name}")
    if entry.version != kind.version:
        raise UserError(
            f"{path}: stages.{name} was made by version {entry.version} of kind {kind.name}, which "
            f"is now version {kind.version}; run and export the recipe again"
        )
    _require_whole(folder / name, entry.sha256, path)
    inputs = {
        role: _build(folder, facts, source, (*above, name), made) for role, source in entry.inputs.items()
    }
    config = kind.config.parse(entry.config, f"{path}: stages.{name}.config")
    roles = {role.name: role for role in kind.roles() if isinstance(role, Role)}
    for role, source in inputs.items():
        if role not in roles or not roles[role].fits(source.kind, source.config):
            raise UserError(
                f"{path}: stages.{name}.inputs: '{source.name}' of kind {source.kind.name} is no "
                f"{role}; export the run again"
            )
    made[name] = Finished(name, kind, config, folder / name, inputs, exported=True)
    return made[name]


def _require_whole(stage: Path, digests: Mapping[str, str], path: Path) -> None:
    """Refuse weights that are not those that were exported; files that are missing say so when they load."""
    for name, digest in digests.items():
        if Path(name).name != name:
            raise UserError(
                f"{path}: stages.{stage.name}.sha256 names {name!r}, which is no file of its folder"
            )
        if (stage / name).is_file() and sha256_of(stage / name) != digest:
            raise UserError(
                f"{stage / name}: is not the file that was exported (another sha256); copy the folder again"
            )


def _format_of(path: Path) -> Any:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError) as error:
        raise UserError(f"{path}: cannot be read ({error}); export the run again") from None
    return data.get("format") if isinstance(data, dict) else None


def _is_name(name: str) -> bool:
    return re.fullmatch(_NAME, name) is not None
