"""The stages of a run that have finished, and previews of those that have not run yet."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from pydantic import Field

from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import GENERATOR, Finished, Inputs, Role, Stage, StageKind, stage_kind
from motionloom.pipeline.store.files import read_record
from motionloom.pipeline.store.run_folder import (
    BUNDLE_FILE,
    STAGE_NAME,
    in_export,
    is_place,
    label_of,
    owner_of,
    stage_folder,
    stages_of,
)
from motionloom.pipeline.store.run_state import RunReader, StageRecord, finished_records
from motionloom.pipeline.store.weights import LayoutFacts


def preview_of(stage: Stage, others: Mapping[str, Stage | Finished]) -> object:
    """What a stage of a recipe will give, as far as it is known before it has run."""
    return stage.kind.preview(stage.config, previews(stage, others))


def previews(stage: Stage, others: Mapping[str, Stage | Finished]) -> Inputs:
    """Previews of a stage's inputs, by role; `others` are those of its recipe, and finished ones outside."""

    def maker(name: str) -> Callable[[], object]:
        found = others[name]
        if isinstance(found, Finished):
            return partial(preview_of_finished, found)
        return partial(preview_of, found, others)

    return Inputs({role: maker(name) for role, name in stage.inputs.items()})


def preview_of_finished(stage: Finished) -> object:
    """What a finished stage gives, without what only running it needs."""
    makers: dict[str, Callable[[], object]] = {}
    for role, source in stage.inputs.items():
        makers[role] = partial(preview_of_finished, source)
    return stage.kind.preview_of_finished(stage, Inputs(makers))


def stages_giving(run: Path, what: str) -> list[str]:
    """Stages of a run's recipe, finished or not, that give `what`, or are of the kind of this name."""
    out = []
    for name, entry in stages_of(run).items():
        where = f"{run / 'recipe.yaml'}: stages.{name}"
        kind = stage_kind(str(entry["kind"]), where)
        fields = {key: value for key, value in entry.items() if key not in ("kind", "inputs")}
        if what == kind.name or what in kind.gives(kind.config.parse(fields, where)):
            out.append(name)
    return out


def finished_stages(run: Path) -> dict[str, Finished]:
    """The finished stages of a run by name, in the recipe's order."""
    made: dict[Path, Finished] = {}
    return {name: _finished(record, made) for name, record in finished_records(run).items()}


def outside_stage(folder: Path) -> Finished | None:
    """A finished stage of a run or of an export, by its folder, for another run; None where there is none."""
    place = folder.resolve()
    if in_export(place):
        return _as_outside(exported_stage(place)) if place.is_dir() else None
    record = RunReader(None).find(place)
    return None if record is None else _finished(record, {})


def _as_outside(stage: Finished) -> Finished:
    inputs = {role: _as_outside(source) for role, source in stage.inputs.items()}
    return replace(stage, name=label_of(stage.folder), inputs=inputs, outside=True)


def _finished(record: StageRecord, made: dict[Path, Finished]) -> Finished:
    """A stage that can be loaded, from its record; each once."""
    if record.folder not in made:
        made[record.folder] = _loadable(record, made)
    return made[record.folder]


def _loadable(record: StageRecord, made: dict[Path, Finished]) -> Finished:
    if in_export(record.folder):
        return _as_outside(exported_stage(record.folder.resolve()))
    where = str(record.folder / "artifact.json")
    kind = stage_kind(record.kind, where)
    if record.version != kind.version and GENERATOR in _gives(kind, record):
        raise UserError(
            f"{where}: made by version {record.version} of stage kind {kind.name}, which is now "
            f"version {kind.version}; run the recipe again"
        )
    run = owner_of(record.folder)
    return Finished(
        record.name,
        kind,
        kind.config.parse(dict(record.config), f"{where}: config"),
        record.folder,
        {role: _finished(source, made) for role, source in record.inputs.items()},
        outside=record.outside,
        gone={role: say_gone(run, record.folder.name, place) for role, place in record.gone.items()},
    )


def say_gone(run: Path, stage: str, place: Path) -> str:
    """What to say where a stage outside a run is not there any more, and one of the run was made from it."""
    return (
        f"{run}: stage '{stage}' was made from {place}, where no finished stage is any more; put it back "
        f"there (a run finds it by the way from its own folder: move both together), or run the recipe again "
        f"with another one in inputs"
    )


def _gives(kind: StageKind, record: StageRecord) -> frozenset[str]:
    try:
        return kind.gives(kind.config.parse(dict(record.config), "config"))
    except UserError:
        return frozenset()


def generators_of(run: Path) -> list[Finished]:
    """The finished stages of a run that generate, its default first.

    Those that the recipe lists as a stage's inputs come first, in that order, then those that a finished
    stage such as `generate` has read: a recipe with several says so which it means. Those of other runs are
    among them where one of these stages reads them. One that another started from is none, unless it is
    listed or read.
    """
    stages = finished_stages(run)
    makers = {stage.folder.resolve(): stage for stage in stages.values() if stage.gives(GENERATOR)}
    read = [
        source
        for stage in stages.values()
        if not stage.gives(GENERATOR)
        for source in stage.inputs.values()
        if source.gives(GENERATOR)
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


def _listed(run: Path) -> list[Path]:
    """Folders of the stages that a run's recipe lists as its model (`inputs: {generators: [gpt]}`)."""
    roles = [entry.get("inputs") for entry in stages_of(run).values()]
    found = [given.get("generators") for given in roles if isinstance(given, dict)]
    names = [str(name) for names in found if isinstance(names, list) for name in names]
    return [(run / name if is_place(name) else stage_folder(run, name)).resolve() for name in names]


# Exports. One may come from anywhere, so nothing outside its folder is ever followed.

FORMAT = 2


class ExportedStage(Config):
    """One stage of an export."""

    kind: str
    version: int
    config: dict[str, object]
    inputs: dict[str, str]
    """Role -> name of another stage of the export."""
    sha256: dict[str, str]
    """File of the stage's folder -> its sha256, which is compared when the stage is opened."""


class BundleFile(Config):
    """`bundle.json`."""

    format: int
    layout: LayoutFacts
    generators: tuple[str, ...]
    """Stages that generate, the default first."""
    stages: dict[str, ExportedStage] = Field(default_factory=dict)
    sampling: dict[str, object] = Field(default_factory=dict)
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
    if read_record(path).get("format") != FORMAT:
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
    if entry is None or not re.fullmatch(STAGE_NAME, name) or not (folder / name).is_dir():
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
    """Refuse files that are not those that were exported; files that are missing say so when they load."""
    for name, digest in digests.items():
        if Path(name).is_absolute() or ".." in Path(name).parts or not Path(name).name:
            raise UserError(
                f"{path}: stages.{stage.name}.sha256 names {name!r}, which is no file of its folder"
            )
        if (stage / name).is_file() and sha256_of(stage / name) != digest:
            raise UserError(
                f"{stage / name}: is not the file that was exported (another sha256); copy the folder again"
            )
