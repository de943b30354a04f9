"""Recipes: one YAML file that says which stages run, with which settings.

    name: humantomato-tiny
    seed: 7
    stages:
      data: {kind: synth, clips: 512}
      stats: {kind: stats}
      tokenizer: {kind: h2vq, net: {width: 128}, train: {steps: 600}}

A stage's inputs are found by role: a stage that needs `data` takes the stage called `data` unless its
`inputs:` names another (or `null`, for an input it can do without). `extends:` starts from another recipe
file, one beside this one or a shipped one by name; a stage that is `null` is left out. `defaults:` holds what
stages share (`defaults.py`). `--set stage.field=value` overrides one value.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator

from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.contract.registry import VARIABLE, stage_kinds
from motionloom.pipeline.contract.stage import Every, Role, Stage
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.defaults import fill, require_used
from motionloom.pipeline.runs.layers import override, read_layers, read_recipe_file
from motionloom.pipeline.runs.shipped import find_recipe, nearest
from motionloom.pipeline.store.yaml import dump_yaml


class RecipeFile(Config):
    """The YAML form; stage entries are checked against the config class of their kind afterwards."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""
    seed: int = Field(0, ge=0)
    hardware: Hardware = Hardware()
    defaults: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """What stages of a kind, or all that train (`trained`), share; see `defaults.py`."""
    stages: dict[str, dict[str, Any]]

    @field_validator("stages")
    @classmethod
    def _plain_names(cls, stages: dict[str, Any]) -> dict[str, Any]:
        """A stage's name is its folder in the run."""
        for name in stages:
            if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", name):
                raise ValueError(f"stage name '{name}': use letters, digits, - and _ only")
        return stages


@dataclass(frozen=True)
class Recipe:
    """A checked recipe: every default filled in, every name valid, stages in an order that can run."""

    name: str
    description: str
    seed: int
    hardware: Hardware
    stages: tuple[Stage, ...]

    def stage(self, name: str) -> Stage:
        """A stage by name, or an error with the nearest one."""
        for stage in self.stages:
            if stage.name == name:
                return stage
        raise UserError(
            f"recipe {self.name} has no stage '{name}'{nearest(name, [s.name for s in self.stages])}"
        )

    def to_yaml(self) -> str:
        """The resolved recipe; reading it again gives an equal recipe."""
        stages: dict[str, Any] = {}
        for stage in self.stages:
            entry: dict[str, Any] = {"kind": stage.kind.name, **stage.config.dump()}
            renamed = _written_inputs(stage)
            stages[stage.name] = {**entry, "inputs": renamed} if renamed else entry
        data = {
            "name": self.name,
            "description": self.description,
            "seed": self.seed,
            "hardware": self.hardware.dump(),
            "stages": stages,
        }
        return dump_yaml(data)


def _written_inputs(stage: Stage) -> dict[str, Any]:
    """The `inputs` of a stage that are not as the roles' names would have them."""
    out: dict[str, Any] = {}
    for role in stage.kind.roles():
        if isinstance(role, Every):
            out[role.name] = [name for key, name in stage.inputs.items() if key == role.key(name)]
        elif stage.inputs.get(role.name) != role.name:
            out[role.name] = stage.inputs.get(role.name)
    return out


def load_recipe(name_or_path: str | Path, overrides: Sequence[str] = ()) -> Recipe:
    """Read, extend, override and check a recipe."""
    path = find_recipe(str(name_or_path))
    data = read_layers(path)
    # Defaults of a base recipe may concern stages that this one has replaced; its own may not.
    require_used(read_recipe_file(path).get("defaults"), data.get("stages"), str(path))
    known = set(data.get("defaults") or {})
    for text in overrides:
        data = override(data, text)
    where = f"{path} with --set" if overrides else str(path)
    file = RecipeFile.parse(data, where)
    require_used(file.defaults.keys() - known, file.stages, where)
    stages = _stages(fill(file.stages, file.defaults, where), where)
    return Recipe(file.name, file.description, file.seed, file.hardware, stages)


def _stages(entries: Mapping[str, dict[str, Any]], where: str) -> tuple[Stage, ...]:
    kinds, parsed = stage_kinds(), []
    for name, entry in entries.items():
        fields = dict(entry)
        kind_name = fields.pop("kind", None)
        renamed = fields.pop("inputs", None) or {}
        if kind_name not in kinds:
            hint = nearest(str(kind_name), list(kinds))
            raise UserError(
                f"{where}: stages.{name}.kind = '{kind_name}' is no stage kind{hint}; a kind of your own "
                f"needs its module in {VARIABLE}"
            )
        kind = kinds[kind_name]
        config = kind.config.parse(fields, f"{where}: stages.{name}")
        parsed.append((Stage(name, kind, config, {}), renamed))
    all_stages = [stage for stage, _ in parsed]
    out = [
        Stage(stage.name, stage.kind, stage.config, _resolve(stage, renamed, all_stages, where))
        for stage, renamed in parsed
    ]
    named = {stage.name: stage for stage in out}
    for stage in out:
        try:
            stage.kind.check(stage, named)
        except UserError as error:
            raise UserError(f"{where}: {error}") from None
    return _in_order(out, where)


def _in_order(stages: list[Stage], where: str) -> tuple[Stage, ...]:
    """The stages so that each stands behind its inputs, else as written: a recipe that `extends` another may
    add a stage that an earlier one reads.
    """
    out: list[Stage] = []
    waiting = list(stages)
    while waiting:
        done = {stage.name for stage in out}
        ready = next((stage for stage in waiting if done.issuperset(stage.inputs.values())), None)
        if ready is None:
            names = ", ".join(stage.name for stage in waiting)
            raise UserError(f"{where}: stages need each other in a circle: {names}")
        waiting.remove(ready)
        out.append(ready)
    return tuple(out)


def _resolve(stage: Stage, renamed: Any, all_stages: list[Stage], where: str) -> dict[str, str]:
    """Role -> stage; a role that is filled by several stages has one entry for each (`Every.key`)."""
    name, roles = stage.name, stage.kind.roles()
    if not isinstance(renamed, dict):
        raise UserError(f"{where}: stages.{name}.inputs must map roles to stages, like {{data: other_data}}")
    for role_name in renamed:
        if role_name not in [role.name for role in roles]:
            hint = nearest(role_name, [role.name for role in roles])
            raise UserError(f"{where}: stages.{name}.inputs: unknown role '{role_name}'{hint}")
    known = [other.name for other in all_stages]
    inputs = {}
    for role in roles:
        if isinstance(role, Every):
            for source in _every(stage, role, renamed.get(role.name), all_stages, where):
                inputs[role.key(source)] = source
            continue
        source = renamed.get(role.name, role.name)
        if source is None and role.optional:
            continue
        if source in known:
            _require_fit(stage, role, all_stages[known.index(source)], all_stages, where)
            inputs[role.name] = source
        elif role.name in renamed or not role.optional:
            raise UserError(
                f"{where}: stage '{name}' needs a stage '{source}' (role '{role.name}')"
                f"{nearest(str(source), [other for other in known if other != name])}"
            )
    return inputs


def _require_fit(stage: Stage, role: Role, source: Stage, all_stages: list[Stage], where: str) -> None:
    if role.fits(source.kind, source.config):
        return
    others = [s.name for s in all_stages if s.name != stage.name and role.fits(s.kind, s.config)]
    raise UserError(
        f"{where}: stages.{stage.name}: its input '{role.name}' is the stage '{source.name}' of kind "
        f"{source.kind.name}, which is no {role.gives}; choose "
        + (" or ".join(others) if others else f"a stage that gives a {role.gives}")
        + f" in stages.{stage.name}.inputs.{role.name}"
    )


def _every(stage: Stage, role: Every, listed: Any, all_stages: list[Stage], where: str) -> list[str]:
    """The stages of an `Every` role: as listed, else all that give what it wants."""
    giving = [other.name for other in all_stages if role.gives in other.kind.gives(other.config)]
    if listed is None:
        return [name for name in giving if name != stage.name]
    if isinstance(listed, str):
        listed = [listed]
    if not isinstance(listed, list):
        raise UserError(f"{where}: stages.{stage.name}.inputs.{role.name} must list stages, like [gpt]")
    for name in listed:
        if name not in giving:
            raise UserError(
                f"{where}: stages.{stage.name}.inputs.{role.name}: '{name}' is no stage that gives a "
                f"{role.gives}{nearest(str(name), giving)}"
            )
    return listed
