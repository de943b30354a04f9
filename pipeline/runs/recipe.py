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

import yaml
from pydantic import Field, field_validator

from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.shipped import shipped_recipes
from motionloom.pipeline.stages.stage import StageConfig, StageKind
from motionloom.pipeline.stages.table import STAGES


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
class Stage:
    """One stage of a resolved recipe. `inputs` maps role to stage name."""

    name: str
    kind: StageKind
    config: StageConfig
    inputs: dict[str, str]


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
            roles = [role.removesuffix("?") for role in stage.kind.inputs]
            renamed = {role: stage.inputs.get(role) for role in roles if stage.inputs.get(role) != role}
            stages[stage.name] = {**entry, "inputs": renamed} if renamed else entry
        data = {
            "name": self.name,
            "description": self.description,
            "seed": self.seed,
            "hardware": self.hardware.dump(),
            "stages": stages,
        }
        return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=100)


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
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not valid YAML: {error}") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
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
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise UserError(f"--set {override}: {error}") from None
    node = data
    for part in parts[:-1]:
        child = node.get(part)
        node[part] = dict(child) if isinstance(child, dict) else {}
        node = node[part]
    # YAML 1.1 reads 1e-4 (no dot) as text; a number is what the user meant.
    node[parts[-1]] = _number(value)


def _number(value: Any) -> Any:
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value


def _stages(file: RecipeFile, where: str) -> tuple[Stage, ...]:
    out: list[Stage] = []
    for name, entry in file.stages.items():
        fields = dict(entry)
        kind_name = fields.pop("kind", None)
        renamed = fields.pop("inputs", None) or {}
        if kind_name not in STAGES:
            hint = nearest(str(kind_name), list(STAGES))
            raise UserError(f"{where}: stages.{name}.kind = '{kind_name}' is no stage kind{hint}")
        kind = STAGES[kind_name]
        config = kind.config.parse(_numbers(fields), f"{where}: stages.{name}")
        out.append(Stage(name, kind, config, _resolve(name, kind, renamed, list(file.stages), where)))
    _check_encoders(out, where)
    _check_starts(out, where)
    return _in_order(out, where)


def _check_encoders(stages: list[Stage], where: str) -> None:
    """A TMA must be given captions by the encoder that it was trained on."""
    named = {stage.name: stage for stage in stages}
    for stage in stages:
        tma, own = named.get(stage.inputs.get("tma", "")), stage.inputs.get("text", "")
        other = tma.inputs.get("text", "") if tma is not None else own
        if own in named and other in named and named[own].config != named[other].config:
            raise UserError(
                f"{where}: stage '{stage.name}' reads captions as '{own}' encodes them, but its TMA "
                f"'{stage.inputs['tma']}' was trained on those of '{other}'; name one text stage for both, "
                f"or leave the TMA out (inputs: {{tma: null}})"
            )


_SIZES = ("layers", "dim", "heads", "ff", "block_size")


def _check_starts(stages: list[Stage], where: str) -> None:
    """A GPT can go on from another's weights where both are one network that reads and writes the same."""
    named = {stage.name: stage for stage in stages}
    for stage in stages:
        start = named.get(stage.inputs.get("start", ""))
        if start is None:
            continue
        ours: Any = stage.config
        theirs: Any = start.config
        if start.kind is not stage.kind:
            wrong = [f"kind ({start.kind.name})"]
        else:
            wrong = [f"net.{size}" for size in _SIZES if getattr(ours.net, size) != getattr(theirs.net, size)]
            wrong += ["prior"] if ours.prior != theirs.prior else []
            roles = ("text", "tokenizer") + (("tma",) if ours.prior == "tma" else ())
            wrong += [f"inputs.{role}" for role in roles if start.inputs.get(role) != stage.inputs.get(role)]
        if wrong:
            raise UserError(
                f"{where}: stage '{stage.name}' starts from '{start.name}', which differs in "
                f"{', '.join(wrong)}; give both the same"
            )


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


def _numbers(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _numbers(v) for k, v in value.items()}
    # Only texts that look like 1e-4: other texts (a folder called "7") stay texts.
    if isinstance(value, str) and value[:1].isdigit() and "e" in value:
        return _number(value)
    return value


def _resolve(name: str, kind: StageKind, renamed: Any, known: list[str], where: str) -> dict[str, str]:
    roles = {role.removesuffix("?"): role.endswith("?") for role in kind.inputs}
    if not isinstance(renamed, dict):
        raise UserError(f"{where}: stages.{name}.inputs must map roles to stages, like {{data: other_data}}")
    for role in renamed:
        if role not in roles:
            raise UserError(
                f"{where}: stages.{name}.inputs: unknown role '{role}'{nearest(role, list(roles))}"
            )
    inputs = {}
    for role, optional in roles.items():
        source = renamed.get(role, role)
        if source is None and optional:
            continue
        if source in known:
            inputs[role] = source
        elif role in renamed or not optional:
            raise UserError(
                f"{where}: stage '{name}' needs a stage '{source}' (role '{role}')"
                f"{nearest(str(source), [other for other in known if other != name])}"
            )
    return inputs
