"""An exported folder: the stages that generation needs, each in a folder of its own, and `bundle.json`."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pydantic import Field

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.contract.registry import stage_kind
from motionloom.pipeline.contract.stage import GENERATOR, Finished, Role
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.weights import LayoutFacts

BUNDLE_FILE = "bundle.json"
FORMAT = 2

_NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]*$"


class ExportedStage(Config):
    """One stage of an export."""

    kind: str
    version: int
    config: dict[str, Any]
    inputs: dict[str, str]
    """Role -> name of another stage of the export."""


class BundleFile(Config):
    """`bundle.json`."""

    format: int
    layout: LayoutFacts
    generators: tuple[str, ...]
    """Stages that generate, the default first."""
    stages: dict[str, ExportedStage] = Field(default_factory=dict)


def write_exported(stages: Iterable[Finished], layout: LayoutFacts, skeleton: Skeleton, out: Path) -> None:
    """Copy what the generators `stages` need to load into `out`; `bundle.json` is written last."""
    makers = list(stages)
    needed: dict[str, Finished] = {}
    for stage in makers:
        _collect(stage, needed)
    entries: dict[str, ExportedStage] = {}
    (out / BUNDLE_FILE).unlink(missing_ok=True)
    for name, stage in needed.items():
        try:
            stage.kind.export(stage, out / name)
        except BaseException:
            for made in (*entries, name):  # nothing that looks like a model is left
                shutil.rmtree(out / made, ignore_errors=True)
            raise
        roles = set(stage.kind.exported(stage.config))
        entries[name] = ExportedStage(
            kind=stage.kind.name,
            version=stage.kind.version,
            config=stage.kind.exported_config(stage.config).dump(),
            inputs={role: source.name for role, source in stage.inputs.items() if role in roles},
        )
    write_json(out / "skeleton.json", _plain(skeleton))
    facts = BundleFile(
        format=FORMAT, layout=layout, generators=tuple(stage.name for stage in makers), stages=entries
    )
    write_json(out / BUNDLE_FILE, facts.dump())


def _collect(stage: Finished, needed: dict[str, Finished]) -> None:
    """Add a stage behind those that it needs."""
    if stage.name in needed:
        return
    for role in stage.kind.exported(stage.config):
        source = stage.inputs.get(role)
        if source is not None:
            _collect(source, needed)
    needed[stage.name] = stage


def open_exported(folder: Path) -> list[Finished]:
    """The stages of an export that generate; nothing outside `folder` is followed."""
    path = folder / BUNDLE_FILE
    if _format_of(path) != FORMAT:
        raise UserError(
            f"{path}: exported by another version of motionloom; export the run again: motionloom export RUN"
        )
    facts = BundleFile.load_json(path)
    made: dict[str, Finished] = {}

    def build(name: str, above: tuple[str, ...]) -> Finished:
        if name in above:
            raise UserError(f"{path}: stage '{name}' needs itself; export the run again")
        if name not in made:
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
            inputs = {role: build(source, (*above, name)) for role, source in entry.inputs.items()}
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

    makers = [build(name, ()) for name in facts.generators]
    for stage in makers:
        if not stage.gives(GENERATOR):
            raise UserError(
                f"{path}: its stage '{stage.name}' of kind {stage.kind.name} generates nothing; export the "
                f"run again"
            )
    return makers


def _format_of(path: Path) -> Any:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError) as error:
        raise UserError(f"{path}: cannot be read ({error}); export the run again") from None
    return data.get("format") if isinstance(data, dict) else None


def _is_name(name: str) -> bool:
    return re.fullmatch(_NAME, name) is not None


def _plain(skeleton: Skeleton) -> dict[str, Any]:
    made = {
        "name": skeleton.name,
        "joints": skeleton.joints,
        "parents": skeleton.parents,
        "offsets": skeleton.rest,
    }
    return dict(json.loads(json.dumps(made)))
