"""The stages of a run that have finished, and previews of those that have not run yet."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.exported import exported_stage
from motionloom.pipeline.contract.registry import stage_kind
from motionloom.pipeline.contract.stage import GENERATOR, Finished, Given, Stage, StageKind
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.outside import in_export, is_place, label_of, owner_of
from motionloom.pipeline.store.run_folder import stage_folder, stages_of


def preview_of(stage: Stage, others: Mapping[str, Stage | Finished]) -> Any:
    """What a stage of a recipe will give, as far as it is known before it has run."""
    return stage.kind.preview(stage.config, previews(stage, others))


def previews(stage: Stage, others: Mapping[str, Stage | Finished]) -> Given:
    """Previews of a stage's inputs, by role; `others` are those of its recipe, and finished ones outside."""

    def maker(name: str) -> Callable[[], Any]:
        found = others[name]
        if isinstance(found, Finished):
            return partial(preview_of_finished, found)
        return partial(preview_of, found, others)

    return Given({role: maker(name) for role, name in stage.inputs.items()})


def preview_of_finished(stage: Finished) -> Any:
    """What a finished stage gives, without what only running it needs."""
    makers: dict[str, Callable[[], Any]] = {}
    for role, source in stage.inputs.items():
        makers[role] = partial(preview_of_finished, source)
    return stage.kind.preview_of_finished(stage, Given(makers))


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
    reader = _Reader(run)
    found = {name: reader.find(stage_folder(run, name)) for name in stages_of(run)}
    return {name: stage for name, stage in found.items() if stage is not None}


def outside_stage(folder: Path) -> Finished | None:
    """A finished stage of a run or of an export, by its folder, for another run; None where there is none."""
    place = folder.resolve()
    if not in_export(place):
        return _Reader(None).find(place)
    return _as_outside(exported_stage(place)) if place.is_dir() else None


def _as_outside(stage: Finished) -> Finished:
    inputs = {role: _as_outside(source) for role, source in stage.inputs.items()}
    return replace(stage, name=label_of(stage.folder), inputs=inputs, outside=True)


class _Reader:
    """Reads finished stages and those that fed them, each once, into other runs too."""

    def __init__(self, home: Path | None) -> None:
        self._home = None if home is None else home.resolve()
        self._made: dict[Path, Finished | None] = {}
        self._places: dict[Path, dict[Path, int]] = {}

    def find(self, folder: Path) -> Finished | None:
        """The stage in a folder; None where it has not finished."""
        key = folder.resolve()
        if key not in self._made:
            self._made[key] = None  # a damaged folder may name itself
            self._made[key] = self._read(folder)
        return self._made[key]

    def _read(self, folder: Path) -> Finished | None:
        if in_export(folder):
            return outside_stage(folder)
        artifact = Artifact.find(folder)
        if artifact is None:
            return None
        where = str(folder / "artifact.json")
        kind = stage_kind(artifact.kind, where)
        if artifact.version != kind.version and GENERATOR in _gives(kind, artifact):
            raise UserError(
                f"{where}: made by version {artifact.version} of stage kind {kind.name}, which is now "
                f"version {kind.version}; run the recipe again"
            )
        run = owner_of(folder)
        inputs, gone = dict[str, Finished](), dict[str, str]()
        for role, source in artifact.inputs.items():
            stage = self.find(source.place(run))
            if stage is not None:
                inputs[role] = stage
            elif source.folder is not None:
                gone[role] = say_gone(run, folder.name, source.place(run))
        config = kind.config.parse(artifact.config, f"{where}: config")
        outside = run.resolve() != self._home
        name = label_of(folder) if outside else folder.name
        return Finished(name, kind, config, folder, self._in_order(inputs, run), outside=outside, gone=gone)

    def _in_order(self, inputs: Mapping[str, Finished], run: Path) -> dict[str, Finished]:
        """Inputs as the run's recipe has their stages, then others; an artifact lists them by role."""
        if run not in self._places:
            names = enumerate(stages_of(run))
            self._places[run] = {stage_folder(run, name).resolve(): number for number, name in names}
        own = self._places[run]
        return dict(sorted(inputs.items(), key=lambda item: own.get(item[1].folder.resolve(), len(own))))


def say_gone(run: Path, stage: str, place: Path) -> str:
    """What to say where a stage outside a run is not there any more, and one of the run was made from it."""
    return (
        f"{run}: stage '{stage}' was made from {place}, where no finished stage is any more; put it back "
        f"there (a run finds it by the way from its own folder: move both together), or run the recipe again "
        f"with another one in inputs"
    )


def _gives(kind: StageKind, artifact: Artifact) -> frozenset[str]:
    try:
        return kind.gives(kind.config.parse(artifact.config, "config"))
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
    listed = [_place(run, name) for name in _listed(run)]
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


def _place(run: Path, name: str) -> Path:
    """The folder of a stage as a run's recipe names it."""
    return (run / name if is_place(name) else stage_folder(run, name)).resolve()


def _listed(run: Path) -> list[str]:
    """Stages that the recipe of a run lists as its model (`inputs: {generators: [gpt, face_gpt]}`)."""
    roles = [entry.get("inputs") for entry in stages_of(run).values()]
    found = [given.get("generators") for given in roles if isinstance(given, dict)]
    return [str(name) for names in found if isinstance(names, list) for name in names]
