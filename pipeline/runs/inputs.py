"""Which stage feeds which role of a recipe's stages: by the role's name, or as `inputs` says."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.stage import Every, Finished, Role, Stage
from motionloom.pipeline.runs.outside import find_outside
from motionloom.pipeline.runs.shipped import nearest
from motionloom.pipeline.store.outside import is_place, label_of


@dataclass
class Sources:
    """What a recipe's stages may be fed by: its own stages, and those outside that they name."""

    own: Sequence[Stage]
    where: str
    """The recipe, for messages."""
    removed: Mapping[str, str] = field(default_factory=dict)
    """Stages that were left out, and what has done so."""
    strict: bool = True
    """Refuse what is gone; else it is noted, since what was made of it may still be used."""
    outside: dict[str, Finished] = field(default_factory=dict)
    gone: dict[tuple[str, str], str] = field(default_factory=dict)
    """Stage and role -> what to say where an input from outside is not there any more."""

    def resolve(self, stage: Stage, given: Any) -> dict[str, str]:
        """Role -> stage; a role that is filled by several stages has one entry for each (`Every.key`)."""
        roles, at = stage.kind.roles(), f"{self.where}: stages.{stage.name}.inputs"
        if not isinstance(given, dict):
            raise UserError(f"{at} must map roles to stages, like {{data: other_data}}")
        for name in given:
            if name not in [role.name for role in roles]:
                hint = nearest(name, [role.name for role in roles])
                raise UserError(f"{at}: unknown role '{name}'{hint}")
        inputs: dict[str, str] = {}
        for role in roles:
            if isinstance(role, Every):
                for key, source in self._every(stage, role, given.get(role.name)):
                    if key in inputs:
                        raise UserError(
                            f"{at}.{role.name}: two are called '{key.partition('.')[2]}'; name each once, or "
                            f"rename the folder of one run"
                        )
                    inputs[key] = source
            elif (one := self._one(stage, role, given)) is not None:
                inputs[role.name] = one
        return inputs

    def _one(self, stage: Stage, role: Role, given: Mapping[str, Any]) -> str | None:
        """The stage in a role; None for an optional one that nothing fills."""
        source = given.get(role.name, role.name)
        if source is None and role.optional:
            return None
        if isinstance(source, str) and is_place(source):
            found = self._find(stage, role.name, source)
            if found is not None:
                self._require_fit(stage, role, Stage(source, found.kind, found.config, {}))
            return None if found is None else source
        there = next((other for other in self.own if other.name == source), None)
        if there is not None:
            self._require_fit(stage, role, there)
            return there.name
        if role.name not in given and role.optional:
            return None
        known = [other.name for other in self.own if other.name != stage.name]
        raise UserError(
            f"{self.where}: stage '{stage.name}' needs a stage '{source}' (role '{role.name}')"
            f"{self._why_not(source) or nearest(str(source), known)}"
        )

    def _why_not(self, name: Any) -> str:
        """Where a stage has been left out, by what."""
        by = self.removed.get(str(name))
        return "" if by is None else f", which {by} leaves out; name another one in inputs, or null"

    def _find(self, stage: Stage, role: str, place: str) -> Finished | None:
        at = f"{self.where}: stages.{stage.name}.inputs.{role}"
        try:
            if place not in self.outside:
                self.outside[place] = find_outside(place, at)
        except UserError as error:
            if self.strict:
                raise
            self.gone[stage.name, role] = str(error)
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

    def _every(self, stage: Stage, role: Every, listed: Any) -> Iterator[tuple[str, str]]:
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
                found = self._find(stage, role.name, name)
                if found is None:
                    continue
                if found.gives(role.gives):
                    yield role.key(label_of(found.folder)), name
                    continue
            elif name in giving:
                yield role.key(name), name
                continue
            hint = nearest(str(name), giving) if giving else ""
            raise UserError(
                f"{at}: '{name}' is no stage that gives a {role.gives}"
                f"{', as ' + self.removed[name] + ' leaves it out' if name in self.removed else ''}{hint}"
            )
