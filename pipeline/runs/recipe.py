"""Recipes: one YAML file that says which stages run, with which settings.

    name: humantomato-tiny
    seed: 7
    stages:
      data: {kind: synth, clips: 512}
      stats: {kind: stats}
      tokenizer: {kind: h2vq, net: {width: 128}, train: {steps: 600}}

A stage's inputs are found by role: a stage that needs `data` takes the stage called `data` unless its
`inputs:` names another (or `null`, for an input it can do without). `extends:` starts from another recipe
file beside this one. `--set stage.field=value` overrides one value.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator

from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.contract.registry import VARIABLE, stage_kinds
from motionloom.pipeline.contract.stage import Every, Stage
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.shipped import shipped_recipes
from motionloom.pipeline.store.yaml import dump_yaml, load_yaml, read_yaml


class RecipeFile(Config):
    """The YAML form; stage entries are checked against the config class of their kind afterwards."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""
    seed: int = Field(0, ge=0)
    hardware: Hardware = Hardware()
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


def nearest(name: str, valid: Sequence[str]) -> str:
    """A hint to append: did you mean 'x'?, or the list of valid names."""
    near = difflib.get_close_matches(name, valid, n=1, cutoff=0.5)
    return f"; did you mean '{near[0]}'?" if near else f"; valid names: {', '.join(valid)}"


def find_recipe(name_or_path: str) -> Path:
    """A recipe file by path, or a shipped recipe by name."""
    path = Path(name_or_path)
    if path.suffix in {".yaml", ".yml"}:
        if not path.is_file():
            raise UserError(f"{path}: no such recipe file")
        return path
    shipped = shipped_recipes()
    if name_or_path not in shipped:
        raise UserError(
            f"no recipe '{name_or_path}'{nearest(name_or_path, list(shipped))} (or give a .yaml file)"
        )
    return shipped[name_or_path]


def load_recipe(name_or_path: str | Path, overrides: Sequence[str] = ()) -> Recipe:
    """Read, extend, override and check a recipe."""
    path = find_recipe(str(name_or_path))
    data = _read(path, depth=0)
    for override in overrides:
        _apply(data, override)
    where = f"{path} with --set" if overrides else str(path)
    file = RecipeFile.parse(data, where)
    return Recipe(file.name, file.description, file.seed, file.hardware, _stages(file, where))


def _read(path: Path, depth: int) -> dict[str, Any]:
    data = read_yaml(path)
    if not isinstance(data, dict):
        raise UserError(f"{path}: a recipe is a mapping with 'name' and 'stages'")
    base = data.pop("extends", None)
    if base is None:
        return data
    if depth > 4:
        raise UserError(f"{path}: 'extends' goes in a circle or more than four files deep")
    beside = path.parent / f"{base}.yaml"
    return _merge(_read(beside if beside.is_file() else find_recipe(str(base)), depth + 1), data)


def _merge(base: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in change.items():
        old = out.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            # A stage of another kind has other fields, so it replaces the old one whole.
            same_kind = value.get("kind", old.get("kind")) == old.get("kind")
            out[key] = _merge(old, value) if same_kind else value
        else:
            out[key] = value
    return out


def _apply(data: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise UserError(f"--set {override}: write it as stage.field=value")
    if parts[0] not in {"seed", "name", "hardware", "description", "stages"}:
        stages = data.get("stages") or {}
        if parts[0] not in stages:
            raise UserError(f"--set {override}: no stage '{parts[0]}'{nearest(parts[0], list(stages))}")
        parts = ["stages", *parts]
    value = load_yaml(text, f"--set {override}")
    node = data
    for part in parts[:-1]:
        child = node.get(part)
        node[part] = dict(child) if isinstance(child, dict) else {}
        node = node[part]
    node[parts[-1]] = value


def _stages(file: RecipeFile, where: str) -> tuple[Stage, ...]:
    kinds, parsed = stage_kinds(), []
    for name, entry in file.stages.items():
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
            inputs[role.name] = source
        elif role.name in renamed or not role.optional:
            raise UserError(
                f"{where}: stage '{name}' needs a stage '{source}' (role '{role.name}')"
                f"{nearest(str(source), [other for other in known if other != name])}"
            )
    return inputs


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
