"""Which stage feeds which role of a recipe's stages: by the role's name, or as `inputs` says.

Stages of other runs, and of exports, are named by their folder: `inputs: {start: runs/other/stages/gpt}`,
seen from the folder of the recipe file, else from the current one. Such a stage must be finished, of the
version that is installed, and made from what its own run holds now.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from motionloom.datasets.base.errors import UserError, nearest
from motionloom.pipeline.contract.lookup import outside_stage
from motionloom.pipeline.contract.stage import CompletedStage, Every, Role, Stage
from motionloom.pipeline.runs.layers import place_name
from motionloom.pipeline.store.artifact import Artifact, require_consistent
from motionloom.pipeline.store.run_folder import in_export, is_place, label_of, owner_of, stage_folder

_LIKE = "name the folder of a stage, like runs/other/stages/gpt"


@dataclass
class Sources:
    """Possible inputs of a recipe's stages: its own stages, and stages outside that they name."""

    own: Sequence[Stage]
    where: str
    """The recipe, for messages."""
    strict: bool = True
    """Refuse what is not there; else it is left out, for who only reads the settings."""
    outside: dict[str, CompletedStage] = field(default_factory=dict)

    def resolve(self, stage: Stage, written: object) -> dict[str, str]:
        """Role -> stage; a role that is filled by several stages has one entry for each (`Every.key`)."""
        roles = stage.kind.roles()
        at = f"{self.where}: stages.{stage.name}.inputs"
        if not isinstance(written, dict):
            raise UserError(f"{at} must map roles to stages, like {{data: other_data}}")
        for name in written:
            if name not in [role.name for role in roles]:
                hint = nearest(name, [role.name for role in roles])
                raise UserError(f"{at}: unknown role '{name}'{hint}")
        inputs: dict[str, str] = {}
        for role in roles:
            if isinstance(role, Every):
                for key, source in self._every(stage, role, written.get(role.name)):
                    if key in inputs:
                        raise UserError(
                            f"{at}.{role.name}: two are called '{key.partition('.')[2]}'; name each once, or "
                            f"rename the folder of one run"
                        )
                    inputs[key] = source
            elif (one := self._one(stage, role, written)) is not None:
                inputs[role.name] = one
        return inputs

    def _one(self, stage: Stage, role: Role, written: Mapping[str, object]) -> str | None:
        """The stage in a role; None for an optional one that nothing fills."""
        source = written.get(role.name, role.name)  # by default the stage called as the role
        if source is None and role.optional:
            return None
        if isinstance(source, str) and is_place(source):
            outside = self._find(stage, role.name, source)
            if outside is not None:
                self._require_fit(stage, role, Stage(source, outside.kind, outside.config, {}))
            return None if outside is None else source
        own = next((other for other in self.own if other.name == source), None)
        if own is not None:
            self._require_fit(stage, role, own)
            return own.name
        if role.name not in written and role.optional:
            return None
        names = [other.name for other in self.own if other.name != stage.name]
        raise UserError(
            f"{self.where}: stage '{stage.name}' needs a stage '{source}' (role '{role.name}')"
            f"{nearest(str(source), names)}"
        )

    def _find(self, stage: Stage, role: str, place: str) -> CompletedStage | None:
        at = f"{self.where}: stages.{stage.name}.inputs.{role}"
        try:
            if place not in self.outside:
                self.outside[place] = find_outside(place, at)
        except UserError:
            if self.strict:
                raise
            return None
        return self.outside[place]

    def _require_fit(self, stage: Stage, role: Role, source: Stage) -> None:
        if role.fits(source.kind, source.config):
            return
        others = [s.name for s in self.own if s.name != stage.name and role.fits(s.kind, s.config)]
        raise UserError(
            f"{self.where}: stages.{stage.name}: its input '{role.name}' is the stage '{source.name}' of "
            f"kind {source.kind.name}, which is no {role.gives}; choose "
            + (" or ".join(others) if others else f"a stage that gives a {role.gives}")
            + f" in stages.{stage.name}.inputs.{role.name}"
        )

    def _every(self, stage: Stage, role: Every, listed: object) -> Iterator[tuple[str, str]]:
        """Key and stage of an `Every` role: as listed, else all of the recipe that give what it wants."""
        giving = [other.name for other in self.own if role.gives in other.kind.gives(other.config)]
        at = f"{self.where}: stages.{stage.name}.inputs.{role.name}"
        if listed is None:
            yield from ((role.key(name), name) for name in giving if name != stage.name)
            return
        if isinstance(listed, str):
            listed = [listed]
        if not isinstance(listed, list):
            raise UserError(f"{at} must list stages, like [gpt]")
        for name in listed:
            if isinstance(name, str) and is_place(name):
                outside = self._find(stage, role.name, name)
                if outside is None:
                    continue
                if outside.gives(role.gives):
                    yield role.key(label_of(outside.folder)), name
                    continue
            elif name in giving:
                yield role.key(name), name
                continue
            hint = nearest(str(name), giving) if giving else ""
            raise UserError(f"{at}: '{name}' is no stage that gives a {role.gives}{hint}")


def find_outside(name: str, where: str) -> CompletedStage:
    """A stage outside the run; a `UserError` says what is wrong with it and begins with `where`."""
    folder = Path(name).resolve()
    if not folder.is_dir():
        raise UserError(f"{where}: {name}: no such folder{_hint(folder)}")
    for file, what, below in (("recipe.yaml", "run", "stages"), ("bundle.json", "export", "")):
        if (folder / file).is_file():
            hint = _hint(folder / below)
            raise UserError(f"{where}: {name}: a whole {what}; name one of its stages{hint}")
    stage = outside_stage(folder)
    if stage is None:
        started = (folder / "started.json").is_file()
        fix = "; finish its run first" if started else f"; {_LIKE}"
        raise UserError(f"{where}: {name}: no finished stage (no artifact.json){fix}")
    if not in_export(folder):
        _require_usable(stage, name, where)
    return stage


def _require_usable(outside: CompletedStage, name: str, where: str) -> None:
    run = owner_of(outside.folder)
    again = f"make it again: motionloom run {run / 'recipe.yaml'} -o {run}"
    for stage in _needed(outside):
        artifact = None if in_export(stage.folder) else Artifact.find(stage.folder)
        if artifact is None:  # an export is checked as it is opened
            continue
        if artifact.version != stage.kind.version:
            raise UserError(
                f"{where}: {name}: '{stage.folder.name}' was made by version {artifact.version} of stage "
                f"kind {artifact.kind}, which is now version {stage.kind.version}; {again}"
            )
        if gone := artifact.missing(stage.folder):
            raise UserError(f"{where}: {name}: {stage.folder / gone} is gone or has another size; {again}")
    try:
        require_consistent(run, [outside.folder.name])
    except UserError as error:
        raise UserError(f"{where}: {name}: {error}") from None


def _needed(stage: CompletedStage) -> Iterable[CompletedStage]:
    """A stage and those that it needs to load."""
    yield stage
    for role in stage.kind.exported(stage.config):
        if role in stage.inputs:
            yield from _needed(stage.inputs[role])


def _hint(folder: Path) -> str:
    """The stages next to a folder that is not one."""
    parent = folder.parent if not folder.is_dir() else folder
    folders = [one.name for one in sorted(parent.iterdir()) if one.is_dir()] if parent.is_dir() else []
    names = [name for name in folders if not name.startswith(".")]
    return nearest(folder.name, names) if names else f"; {_LIKE}"


def as_stages(outside: Mapping[str, CompletedStage]) -> dict[str, Stage]:
    """Outside stages and all above them, as the checks of a recipe see stages."""
    out: dict[str, Stage] = {}
    for name, stage in outside.items():
        _add(name, stage, out)
    return out


def _add(name: str, stage: CompletedStage, out: dict[str, Stage]) -> None:
    if name in out:
        return
    above = {role: (place_name(source.folder), source) for role, source in stage.inputs.items()}
    out[name] = Stage(name, stage.kind, stage.config, {role: place for role, (place, _) in above.items()})
    for place, source in above.values():
        _add(place, source, out)


def require_elsewhere(run: Path, stage: Stage, outside: Mapping[str, CompletedStage]) -> None:
    """Refuse, as an input from outside, a stage of the run itself, or one made from what it shall feed."""
    target = stage_folder(run, stage.name).resolve()
    for name in stage.inputs.values():
        if name not in outside:
            continue
        source = outside[name]
        if owner_of(source.folder).resolve() == run.resolve():
            raise UserError(
                f"stage '{stage.name}': {name} is a stage of this very run; name it '{source.folder.name}'"
            )
        if any(above.folder.resolve() == target for above in source.upstream()):
            raise UserError(
                f"stage '{stage.name}': {label_of(source.folder)} was itself made from this stage of {run}; "
                f"choose another folder with -o"
            )
