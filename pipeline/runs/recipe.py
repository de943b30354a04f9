"""Recipes: one YAML file that says which stages run, with which settings.

    name: humantomato-tiny
    seed: 7
    stages:
      data: {kind: synth, clips: 512}
      stats: {kind: stats}
      tokenizer: {kind: h2vq, net: {width: 128}, train: {steps: 600}}

A stage's inputs are found by role: a stage that needs `data` takes the stage called `data` unless its
`inputs:` names another (or `null`, for an input it can do without), or the path of a stage of another run or
of an export (`start: runs/other/stages/gpt`). `seed` is everybody's but a training's that
has its own (`train.seed`). What else a recipe may say, `extends`, `start`, `defaults`, and
`--set` over it are resolved first (`resolve.py`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError, nearest
from motionloom.datasets.base.register import VARIABLE
from motionloom.pipeline.contract.stage import CompletedStage, Every, Stage, stage_kinds
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.inputs import Sources, as_stages
from motionloom.pipeline.runs.layers import Tree, find_recipe
from motionloom.pipeline.runs.resolve import resolve
from motionloom.pipeline.store.run_folder import STAGE_NAME, place_from
from motionloom.pipeline.store.yaml import dump_yaml, require_counts


class RecipeFile(Config):
    """The YAML form; stage entries are checked against the config class of their kind afterwards."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""
    seed: int = Field(0, ge=0)
    hardware: Hardware = Hardware()
    start: str | None = None
    """A trained model that stages go on from: one of the package, or the folder of an export or a run."""
    defaults: dict[str, Tree] = Field(default_factory=dict)
    """Settings that stages of a kind, or all that train (`trained`), share."""
    stages: dict[str, Tree]

    @field_validator("hardware")
    @classmethod
    def _counted(cls, hardware: Hardware) -> Hardware:
        require_counts(hardware.model_dump(), "hardware")
        return hardware

    @field_validator("stages")
    @classmethod
    def _plain_names(cls, stages: dict[str, Tree]) -> dict[str, Tree]:
        """A stage's name is its folder in the run."""
        for name in stages:
            if not re.fullmatch(STAGE_NAME, name):
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
    outside: Mapping[str, CompletedStage] = field(default_factory=dict)
    """Stages of other runs and of exports that its stages read, by the names that `Stage.inputs` has."""

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

    def to_yaml(self, run: Path | None = None) -> str:
        """The resolved recipe; reading it again gives an equal recipe.

        Stages outside are written as they are seen from the folder `run` where it is to lie, or absolutely.
        """
        return dump_yaml(self.tree(run))

    def tree(self, run: Path | None = None) -> Tree:
        """The resolved recipe as plain data; `run` as in `to_yaml`."""
        stages: dict[str, Tree] = {}
        for stage in self.stages:
            entry: Tree = {"kind": stage.kind.name, **stage.config.dump()}
            renamed = self._written_inputs(stage, run)
            stages[stage.name] = {**entry, "inputs": renamed} if renamed else entry
        return {
            "name": self.name,
            "description": self.description,
            "seed": self.seed,
            "hardware": self.hardware.dump(),
            "stages": stages,
        }

    def _written_inputs(self, stage: Stage, run: Path | None) -> Tree:
        """The `inputs` of a stage that are not as the roles' names would have them."""

        def written(name: str) -> str:
            if name not in self.outside:
                return name
            place = self.outside[name].folder.resolve()
            return str(place) if run is None else place_from(run, place)

        out: Tree = {}
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

    Unless `strict`, inputs from outside that are not there are left out, for who only reads the settings.
    """
    path = find_recipe(str(name_or_path))
    where = f"{path} with --set" if overrides else str(path)
    file = RecipeFile.parse(resolve(path, overrides, where), where)
    parsed = _parse(file.stages, where)
    sources = Sources([stage for stage, _ in parsed], where, strict)
    stages = [replace(stage, inputs=sources.resolve(stage, written)) for stage, written in parsed]
    if strict:
        _check(stages, sources, where)
    return Recipe(
        file.name, file.description, file.seed, file.hardware, _in_order(stages, sources, where),
        outside=sources.outside,
    )  # fmt: skip


def _parse(entries: Mapping[str, dict[str, Any]], where: str) -> list[tuple[Stage, object]]:
    """The stages without their inputs, and what was written of those."""
    kinds = stage_kinds()
    parsed = []
    for name, entry in entries.items():
        fields = dict(entry)
        kind_name = fields.pop("kind", None)
        renamed = fields.pop("inputs", None) or {}
        if not isinstance(kind_name, str) or kind_name not in kinds:
            hint = nearest(str(kind_name), list(kinds))
            raise UserError(
                f"{where}: stages.{name}.kind = '{kind_name}' is no stage kind{hint}; a kind of your own "
                f"needs its module in {VARIABLE}"
            )
        kind = kinds[kind_name]
        parsed.append((Stage(name, kind, kind.config.parse(fields, f"{where}: stages.{name}"), {}), renamed))
    return parsed


def _check(stages: Sequence[Stage], sources: Sources, where: str) -> None:
    """Have each kind check its stage together with the others."""
    named = {stage.name: stage for stage in stages} | as_stages(sources.outside)
    for stage in stages:
        try:
            stage.kind.check(stage, named)
        except UserError as error:
            raise UserError(f"{where}: {error}") from None


def _in_order(stages: Sequence[Stage], sources: Sources, where: str) -> tuple[Stage, ...]:
    """The stages sorted so that each comes after its inputs, otherwise as written: a recipe that `extends`
    another may add a stage that an earlier one reads.
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
