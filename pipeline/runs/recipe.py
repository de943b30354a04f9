"""Recipes: one YAML file that says which stages run, with which settings.

    name: humantomato-tiny
    seed: 7
    stages:
      data: {kind: synth, clips: 512}
      stats: {kind: stats}
      tokenizer: {kind: h2vq, net: {width: 128}, train: {steps: 600}}

A stage's inputs are found by role: a stage that needs `data` takes the stage called `data` unless its
`inputs:` names another (or `null`, for an input it can do without), or the path of a stage of another run or
of an export (`start: runs/other/stages/gpt`). `seed` is everybody's; `data_seed`, where it is given, is that
of all that comes before the first training. `extends:` starts from another recipe file, one beside this one
or a shipped one by name; a stage that is `null` is left out. `defaults:` holds what stages share
(`defaults.py`), and `start:` names a trained model to go on from (`starting.py`).
`--set stage.field=value` overrides one value.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator

from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.contract.registry import VARIABLE, stage_kinds
from motionloom.pipeline.contract.stage import Every, Finished, Stage
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.defaults import fill, require_used
from motionloom.pipeline.runs.inputs import Sources
from motionloom.pipeline.runs.layers import override, read_layers, read_recipe_file
from motionloom.pipeline.runs.outside import as_stages
from motionloom.pipeline.runs.shipped import find_recipe, nearest
from motionloom.pipeline.runs.starting import with_start
from motionloom.pipeline.store.outside import place_from
from motionloom.pipeline.store.yaml import dump_yaml


class RecipeFile(Config):
    """The YAML form; stage entries are checked against the config class of their kind afterwards."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""
    seed: int = Field(0, ge=0)
    data_seed: int | None = Field(None, ge=0)
    """Of all that comes before the first training; null = `seed`."""
    hardware: Hardware = Hardware()
    start: str | None = None
    """A trained model that stages go on from: one of the package, or the folder of an export or a run; see
    `starting.py`."""
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
    data_seed: int | None = None
    outside: Mapping[str, Finished] = field(default_factory=dict)
    """Stages of other runs and of exports that its stages read, by the names that `Stage.inputs` has."""
    gone: Mapping[tuple[str, str], str] = field(default_factory=dict, compare=False)
    """Stage and role -> what to say of an input from outside that is not there any more."""

    def stage(self, name: str, asked: str = "") -> Stage:
        """A stage by name, or an error with the nearest one; `asked` is the option that names it."""
        for stage in self.stages:
            if stage.name == name:
                return stage
        raise UserError(
            f"{asked and f'{asked} {name}: '}recipe {self.name} has no stage '{name}'"
            f"{nearest(name, [s.name for s in self.stages])}"
        )

    def above(self, stage: Stage) -> list[Stage]:
        """The stages of the recipe that feed one of them."""
        return [self.stage(name) for name in stage.inputs.values() if name not in self.outside]

    def seed_of(self, stage: Stage) -> int:
        """The seed of a stage: `data_seed` where nothing trained comes before it, and it trains nothing."""
        if self.data_seed is None or not self._untrained(stage):
            return self.seed
        return self.data_seed

    def _untrained(self, stage: Stage) -> bool:
        outside = [self.outside[name] for name in stage.inputs.values() if name in self.outside]
        trained = any(one.kind.trains for found in outside for one in (found, *found.upstream()))
        return not stage.kind.trains and not trained and all(map(self._untrained, self.above(stage)))

    def to_yaml(self, run: Path | None = None) -> str:
        """The resolved recipe; reading it again gives an equal recipe.

        Stages outside are written as they are seen from the folder `run` where it is to lie, or absolutely.
        """
        stages: dict[str, Any] = {}
        for stage in self.stages:
            entry: dict[str, Any] = {"kind": stage.kind.name, **stage.config.dump()}
            renamed = self._written_inputs(stage, run)
            stages[stage.name] = {**entry, "inputs": renamed} if renamed else entry
        data = {
            "name": self.name,
            "description": self.description,
            "seed": self.seed,
            **({} if self.data_seed is None else {"data_seed": self.data_seed}),
            "hardware": self.hardware.dump(),
            "stages": stages,
        }
        return dump_yaml(data)

    def _written_inputs(self, stage: Stage, run: Path | None) -> dict[str, Any]:
        """The `inputs` of a stage that are not as the roles' names would have them."""

        def written(name: str) -> str:
            if name not in self.outside:
                return name
            place = self.outside[name].folder.resolve()
            return str(place) if run is None else place_from(run, place)

        out: dict[str, Any] = {}
        for role in stage.kind.roles():
            if isinstance(role, Every):
                keys = [key for key in stage.inputs if key.startswith(f"{role.name}.")]
                out[role.name] = [written(stage.inputs[key]) for key in keys]
            elif stage.inputs.get(role.name) != role.name:
                name = stage.inputs.get(role.name)
                out[role.name] = None if name is None else written(name)
        return out


def load_recipe(name_or_path: str | Path, overrides: Sequence[str] = (), *, strict: bool = True) -> Recipe:
    """Read, extend, override and check a recipe.

    Unless `strict`, inputs from outside may be gone: what a run has made of them may still be used.
    """
    path = find_recipe(str(name_or_path))
    layers = read_layers(path)
    # Defaults of a base recipe may concern stages that this one has replaced; its own may not.
    require_used(read_recipe_file(path).get("defaults"), layers.data.get("stages"), str(path))
    known = set(layers.data.get("defaults") or {})
    for text in overrides:
        layers = override(layers, text)
    where = f"{path} with --set" if overrides else str(path)
    data = with_start(layers.data, where)
    file = RecipeFile.parse(data, where)
    require_used(file.defaults.keys() - known, file.stages, where)
    parsed = _parse(fill(file.stages, file.defaults, where), where)
    sources = Sources([stage for stage, _ in parsed], where, layers.removed, strict)
    stages = [replace(stage, inputs=sources.resolve(stage, given)) for stage, given in parsed]
    if not sources.gone:
        _check(stages, sources, where)
    return Recipe(
        file.name, file.description, file.seed, file.hardware, _in_order(stages, sources, where),
        data_seed=file.data_seed, outside=sources.outside, gone=sources.gone,
    )  # fmt: skip


def _parse(entries: Mapping[str, dict[str, Any]], where: str) -> list[tuple[Stage, Any]]:
    """The stages without their inputs, and what was written of those."""
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
        parsed.append((Stage(name, kind, kind.config.parse(fields, f"{where}: stages.{name}"), {}), renamed))
    return parsed


def _check(stages: Sequence[Stage], sources: Sources, where: str) -> None:
    """What each kind refuses in the company of the others."""
    named = {stage.name: stage for stage in stages} | as_stages(sources.outside)
    for stage in stages:
        try:
            stage.kind.check(stage, named)
        except UserError as error:
            raise UserError(f"{where}: {error}") from None


def _in_order(stages: Sequence[Stage], sources: Sources, where: str) -> tuple[Stage, ...]:
    """The stages so that each stands behind its inputs, else as written: a recipe that `extends` another may
    add a stage that an earlier one reads.
    """
    out: list[Stage] = []
    waiting = list(stages)
    while waiting:
        done = {*(stage.name for stage in out), *sources.outside}
        ready = next((stage for stage in waiting if done.issuperset(stage.inputs.values())), None)
        if ready is None:
            names = ", ".join(stage.name for stage in waiting)
            raise UserError(f"{where}: stages need each other in a circle: {names}")
        waiting.remove(ready)
        out.append(ready)
    return tuple(out)
