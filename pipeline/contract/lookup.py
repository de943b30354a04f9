"""Finished stages of a run or export, and previews of stages that have not run yet."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from pydantic import Field

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import (
    CAPTIONER,
    GENERATOR,
    CompletedStage,
    Inputs,
    Role,
    Stage,
    StageKind,
    stage_kind,
    stage_kinds,
)
from motionloom.pipeline.store.files import read_record
from motionloom.pipeline.store.run_folder import (
    BUNDLE_FILE,
    STAGE_NAME,
    in_export,
    is_place,
    owner_of,
    stage_folder,
    stages_of,
)
from motionloom.pipeline.store.run_state import RunReader, StageRecord, finished_records, not_here
from motionloom.pipeline.store.weights import LayoutFacts


def preview_of(
    stage: Stage | CompletedStage, others: Mapping[str, Stage | CompletedStage] | None = None
) -> object:
    """Return what is known of a stage's output before it has run; a finished one's may lack its weights."""
    if isinstance(stage, CompletedStage):
        makers = {role: partial(preview_of, source) for role, source in stage.inputs.items()}
        return stage.kind.preview_of_finished(stage, Inputs(makers))
    return stage.kind.preview(stage.config, previews(stage, others or {}))


def previews(stage: Stage, others: Mapping[str, Stage | CompletedStage]) -> Inputs:
    """Previews of a stage's inputs, by role; `others` are those of its recipe, and finished ones outside."""
    return Inputs({role: partial(preview_of, others[name], others) for role, name in stage.inputs.items()})


def stages_giving(run: Path, what: str) -> list[str]:
    """Stages of a run's recipe, finished or not, that could fill a role that takes `what`."""
    out = []
    for name, entry in stages_of(run).items():
        where = f"{run / 'recipe.yaml'}: stages.{name}"
        kind = stage_kind(str(entry["kind"]), where)
        fields = {key: value for key, value in entry.items() if key not in ("kind", "inputs")}
        if Role(what, False, what).fits(kind, kind.config.parse(fields, where)):
            out.append(name)
    return out


def finished_stages(run: Path) -> dict[str, CompletedStage]:
    """The finished stages of a run by name, in the recipe's order."""
    made: dict[Path, CompletedStage] = {}
    return {name: _finished(record, made) for name, record in finished_records(run).items()}


def outside_stage(folder: Path) -> CompletedStage | None:
    """A finished stage of a run or of an export, by its folder, for another run; None where there is none."""
    record = RunReader(None).find(folder.resolve())
    return None if record is None else _finished(record, {})


def _finished(record: StageRecord, made: dict[Path, CompletedStage]) -> CompletedStage:
    """A stage that can be loaded, from its record; each once."""
    if record.folder not in made:
        made[record.folder] = _loadable(record, made)
    return made[record.folder]


def _loadable(record: StageRecord, made: dict[Path, CompletedStage]) -> CompletedStage:
    folder = record.folder
    where = str(folder / "artifact.json")
    run = owner_of(folder)
    exported = in_export(folder)
    kind = stage_kind(record.kind, where, read_bundle(run).packages if exported else ())
    if record.version != kind.version and (exported or _gives(kind, record) & {GENERATOR, CAPTIONER}):
        raise UserError(
            f"{where}: made by version {record.version} of stage kind {kind.name}, which is now "
            f"version {kind.version}; run the recipe again{' and export it' * exported}"
        )
    inputs = {role: _finished(source, made) for role, source in record.inputs.items()}
    if exported:
        _require_roles(kind, inputs, where)
    config = kind.config.parse(dict(record.config), f"{where}: config")
    for role, place in record.gone.items():
        if role in kind.exported(config):
            raise UserError(
                f"{run}: stage '{folder.name}' was made from {place}, where no finished stage is; put "
                f"it back there (a run finds it by the way from its own folder: move both together)"
            )
    return CompletedStage(
        record.name, kind, config, folder, inputs, exported=exported, outside=record.outside
    )


def _require_roles(kind: StageKind, inputs: Mapping[str, CompletedStage], where: str) -> None:
    """Refuse stages of an export in roles that they cannot fill."""
    roles = {role.name: role for role in kind.roles() if isinstance(role, Role)}
    for role, source in inputs.items():
        if role not in roles or not roles[role].fits(source.kind, source.config):
            raise UserError(
                f"{where}: inputs: '{source.name}' of kind {source.kind.name} is no {role}; "
                f"export the run again"
            )


def _gives(kind: StageKind, record: StageRecord) -> frozenset[str]:
    try:
        return kind.gives(kind.config.parse(dict(record.config), "config"))
    except UserError:
        return frozenset()


def generators_of(run: Path) -> list[CompletedStage]:
    """The finished stages of a run that generate, its default first.

    First come those that the recipe lists as a stage's inputs, in that order, then those that a finished
    stage such as `generate` has read, also from other runs. A generator from which another was trained on is
    left out, unless it is listed or read.
    """
    stages = finished_stages(run)
    makers = {stage.folder.resolve(): stage for stage in stages.values() if stage.gives(GENERATOR)}
    read = [
        source
        for stage in stages.values()
        if not stage.gives(GENERATOR)
        for role, source in stage.inputs.items()
        if source.gives(GENERATOR) and role.partition(".")[0] == "generators"
    ]
    listed = _listed(run)
    for place in listed:
        if place not in makers and owner_of(place) != run.resolve():
            found = outside_stage(place)
            if found is not None and found.gives(GENERATOR):
                makers[place] = found
    makers |= {source.folder.resolve(): source for source in read if source.outside}
    named = dict.fromkeys((*listed, *(source.folder.resolve() for source in read)))
    begun = {stage.inputs["start"].folder.resolve() for stage in makers.values() if "start" in stage.inputs}
    order = dict.fromkeys((*named, *(place for place in makers if place not in begun)))
    return [makers[place] for place in order if place in makers]


def captioners_of(run: Path) -> list[CompletedStage]:
    """The finished stages of a run that caption motions, in the recipe's order."""
    return [stage for stage in finished_stages(run).values() if stage.gives(CAPTIONER)]


def _listed(run: Path) -> list[Path]:
    """Folders of the stages that a run's recipe lists as its model (`inputs: {generators: [gpt]}`)."""
    roles = [entry.get("inputs") for entry in stages_of(run).values()]
    found = [given.get("generators") for given in roles if isinstance(given, dict)]
    names = [str(name) for names in found if isinstance(names, list) for name in names]
    return [(run / name if is_place(name) else stage_folder(run, name)).resolve() for name in names]


# Exports: folders of stages like a run's, which hold nothing else.

FORMAT = 3


class BundleFile(Config):
    """`bundle.json`."""

    format: int
    layout: LayoutFacts
    generators: tuple[str, ...]
    """Stages that generate, the default first."""
    captioners: tuple[str, ...] = ()
    """Stages that caption motions."""
    packages: tuple[str, ...] = Field((), exclude_if=lambda packages: not packages)
    """Packages beside motionloom that its stages need, as `name==version`."""
    sampling: dict[str, object] = Field(default_factory=dict)
    """Recommended fields of `SamplingConfig`."""


def open_exported(folder: Path, what: str = GENERATOR) -> list[CompletedStage]:
    """The stages of an export that generate, the default first; or that give `CAPTIONER`."""
    path = folder / BUNDLE_FILE
    reader = RunReader(folder)
    made = dict[Path, CompletedStage]()
    makers = []
    listed = read_bundle(folder)
    for name in listed.captioners if what == CAPTIONER else listed.generators:
        record = reader.find(folder / name) if re.fullmatch(STAGE_NAME, name) else None
        if record is None:
            raise UserError(not_here(folder, name))
        if what == CAPTIONER and record.kind not in stage_kinds():
            continue  # a model generates where the folder of its captioner was taken out
        stage = _finished(record, made)
        if not stage.gives(what):
            does = "captions" if what == CAPTIONER else "generates"
            raise UserError(
                f"{path}: its stage '{stage.name}' of kind {stage.kind.name} {does} nothing; export the "
                f"run again"
            )
        makers.append(stage)
    return makers


def exported_sampling(folder: Path) -> SamplingConfig:
    """Return the sampling settings that an export recommends; other fields are not set."""
    return SamplingConfig.parse(read_bundle(folder).sampling, f"{folder / BUNDLE_FILE}: sampling")


def read_bundle(folder: Path) -> BundleFile:
    """Return the description of an export."""
    path = folder / BUNDLE_FILE
    if read_record(path).get("format") != FORMAT:
        raise UserError(
            f"{path}: exported by another version of motionloom; export the run again: motionloom export RUN"
        )
    return BundleFile.load_json(path)
