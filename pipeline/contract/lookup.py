"""The stages of a run that have finished, and previews of those that have not run yet."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.registry import stage_kind
from motionloom.pipeline.contract.stage import GENERATOR, Finished, Given, Stage, StageKind
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.run_folder import stage_folder, stages_of


def preview_of(stage: Stage, others: Mapping[str, Stage]) -> Any:
    """What a stage of a recipe will give, as far as it is known before it has run."""
    return stage.kind.preview(stage.config, previews(stage, others))


def previews(stage: Stage, others: Mapping[str, Stage]) -> Given:
    """Previews of a stage's inputs, by role."""

    def maker(name: str) -> Callable[[], Any]:
        return lambda: preview_of(others[name], others)

    return Given({role: maker(name) for role, name in stage.inputs.items()})


def stages_giving(run: Path, what: str) -> list[str]:
    """Stages of a run's recipe, finished or not, that give `what` to others."""
    out = []
    for name, entry in stages_of(run).items():
        where = f"{run / 'recipe.yaml'}: stages.{name}"
        kind = stage_kind(str(entry["kind"]), where)
        fields = {key: value for key, value in entry.items() if key not in ("kind", "inputs")}
        if what in kind.gives(kind.config.parse(fields, where)):
            out.append(name)
    return out


def finished_stages(run: Path) -> dict[str, Finished]:
    """The finished stages of a run by name, in the recipe's order."""
    out: dict[str, Finished] = {}

    def find(name: str) -> Finished | None:
        if name not in out:
            folder = stage_folder(run, name)
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
            inputs = {role: find(source.stage) for role, source in artifact.inputs.items()}
            config = kind.config.parse(artifact.config, f"{where}: config")
            found = {role: stage for role, stage in inputs.items() if stage is not None}
            out[name] = Finished(name, kind, config, folder, _in_order(found, names))
        return out[name]

    names = list(stages_of(run))
    for name in names:
        find(name)
    return {name: out[name] for name in names if name in out}


def _gives(kind: StageKind, artifact: Artifact) -> frozenset[str]:
    try:
        return kind.gives(kind.config.parse(artifact.config, "config"))
    except UserError:
        return frozenset()


def _in_order(inputs: Mapping[str, Finished], names: Sequence[str]) -> dict[str, Finished]:
    """Inputs as the recipe has their stages; an artifact lists them by role."""
    place = {name: number for number, name in enumerate(names)}
    return dict(sorted(inputs.items(), key=lambda item: place.get(item[1].name, len(place))))


def generators_of(run: Path) -> list[Finished]:
    """The finished stages of a run that generate, its default first.

    Those that the recipe lists as a stage's inputs come first, in that order, then those that a finished
    stage such as `generate` has read: a recipe with several says so which it means.
    """
    stages = finished_stages(run)
    makers = {name: stage for name, stage in stages.items() if stage.gives(GENERATOR)}
    read = [
        source.name
        for stage in stages.values()
        if not stage.gives(GENERATOR)
        for source in stage.inputs.values()
    ]
    names = dict.fromkeys((*_listed(run), *read, *makers))
    return [makers[name] for name in names if name in makers]


def _listed(run: Path) -> list[str]:
    """Stages that the recipe of a run lists as inputs (`inputs: {generators: [gpt, face_gpt]}`)."""
    roles = [entry.get("inputs") for entry in stages_of(run).values()]
    found = [names for given in roles if isinstance(given, dict) for names in given.values()]
    return [str(name) for names in found if isinstance(names, list) for name in names]
