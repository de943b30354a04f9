"""The contract of a stage: what every kind answers for itself, so that nothing else holds a list of kinds.

A kind says which inputs it takes and what it gives, runs, and loads again what it left behind. Kinds that
train say more (`stages/trained.py`). The graph, the dry run, exports, `generate`, `evaluate` and the report
ask these questions of the stages of a run; a new stage answers them in its own file and is registered by one
line (`registry.py`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import torch
from pydantic import BaseModel, model_validator
from rich.console import Console

from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.contract.generation import MotionGenerator
from motionloom.pipeline.contract.showing import Curve, ModelCard, Showing
from motionloom.pipeline.contract.units import WORK, Units
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.store.run_state import RunState

CPU = torch.device("cpu")

GENERATOR = "generator"
"""What a stage gives that makes motion: `StageKind.generator`."""

ALIGNMENT = "alignment"
"""What a stage gives that embeds text and motion in one space: it loads as a `LoadedTma`."""

FACE_ALIGNMENT = "face_alignment"
"""The same of captions of faces and of expressions."""

SHOWING = "showing"
"""What a stage gives that has curves or figures for the report."""


class StageConfig(Config):
    """Base of every stage's config."""

    @model_validator(mode="before")
    @classmethod
    def _keep_defaults(cls, data: Any) -> Any:
        """A group of settings of which some are given keeps the stage's own defaults of the others."""
        if not isinstance(data, dict):
            return data
        out = dict(data)
        for name, info in cls.model_fields.items():
            if isinstance(info.default, BaseModel) and isinstance(out.get(name), dict):
                out[name] = _over(info.default.model_dump(mode="json"), out[name])
        return out

    def require_fit(self, hardware: Hardware) -> None:
        """Refuse, before anything runs, settings that cannot run on this hardware."""


@dataclass(frozen=True)
class Role:
    """An input of a stage, filled by the stage of the same name unless the recipe names another."""

    name: str
    optional: bool
    gives: str
    """What must fill it: a stage of the kind of this name, or one that gives this."""

    @staticmethod
    def parse(text: str) -> Role:
        """As it stands in `takes`: "stats", "tma?", "face_tokenizer?: tokenizer"."""
        left, _, gives = text.partition(":")
        name = left.strip().removesuffix("?")
        return Role(name, left.strip().endswith("?"), gives.strip() or name)

    def fits(self, kind: StageKind, config: Any) -> bool:
        """Whether a stage of this kind and config may fill it."""
        return self.gives == kind.name or self.gives in kind.gives(config)


@dataclass(frozen=True)
class Every:
    """An input filled by every other stage that gives something, or by those the recipe lists, in order."""

    name: str
    gives: str
    optional: ClassVar[bool] = True

    def key(self, stage: str) -> str:
        """The name under which one of them stands among a stage's inputs."""
        return f"{self.name}.{stage}"


@dataclass(frozen=True)
class Stage:
    """One stage of a resolved recipe. `inputs` maps roles to stage names, or to places outside the run."""

    name: str
    kind: StageKind
    config: Any
    inputs: dict[str, str]


class MissingInputError(UserError, KeyError):
    """A role was asked for that no finished stage fills."""

    def __str__(self) -> str:
        return str(self.args[0])


class Given(Mapping[str, Any]):
    """What the inputs of a stage give, by role; each is made when it is first asked for."""

    def __init__(self, makers: Mapping[str, Callable[[], Any]]) -> None:
        self._makers = dict(makers)
        self._made: dict[str, Any] = {}

    def __getitem__(self, role: str) -> Any:
        if role not in self._makers:
            raise MissingInputError(f"no finished '{role}' stage here; run the recipe to the end first")
        if role not in self._made:
            self._made[role] = self._makers[role]()
        return self._made[role]

    def __contains__(self, role: object) -> bool:
        return role in self._makers

    def __iter__(self) -> Any:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)


@dataclass(frozen=True)
class Finished:
    """A finished stage and those that fed it."""

    name: str
    kind: StageKind
    config: Any
    folder: Path
    inputs: Mapping[str, Finished]
    exported: bool = False
    """In an exported folder, which may come from anywhere: nothing outside `folder` is followed."""
    outside: bool = False
    """Of another run than the one in which it is looked up, or of an export; then `name` names both."""
    gone: Mapping[str, str] = field(default_factory=dict)
    """Roles whose stages have gone since, and what to say where one of them is needed."""

    def gives(self, what: str) -> bool:
        """Whether other stages may ask this one for `what`."""
        return what in self.kind.gives(self.config)

    def upstream(self) -> Iterator[Finished]:
        """All stages above this one, each once, those it reads first."""
        seen: set[Path] = set()
        todo = list(self.inputs.values())
        while todo:
            stage = todo.pop(0)
            if stage.folder not in seen:
                seen.add(stage.folder)
                yield stage
                todo += stage.inputs.values()


class Shelf:
    """What finished stages give, each loaded once, all on one device."""

    def __init__(self, device: torch.device = CPU) -> None:
        self.device = device
        self._loaded: dict[Path, Any] = {}

    def get(self, stage: Finished) -> Any:
        """What `stage` gives."""
        if stage.folder not in self._loaded:
            self._loaded[stage.folder] = stage.kind.load(stage, self.given_to(stage), self.device)
        return self._loaded[stage.folder]

    def given(self, inputs: Mapping[str, Finished]) -> Given:
        """What `inputs` give, by role."""
        return Given({role: partial(self.get, stage) for role, stage in inputs.items()})

    def given_to(self, stage: Finished) -> Given:
        """What the inputs of a finished stage give; one that is gone says so where it is asked for."""
        makers = {role: partial(self.get, source) for role, source in stage.inputs.items()}
        return Given({**{role: partial(_refuse, said) for role, said in stage.gone.items()}, **makers})

    def generator(self, stage: Finished) -> MotionGenerator:
        """The generator that a stage is."""
        return stage.kind.generator(stage, self.given_to(stage), self.device)


def _refuse(said: str) -> Any:
    raise UserError(said)


@dataclass(frozen=True)
class StageContext:
    """All that a stage's `run` may use. `inputs` maps each role to a finished stage."""

    name: str
    recipe: str
    """Name of the recipe, for people."""
    config: Any
    folder: Path
    inputs: Mapping[str, Finished]
    seed: int
    hardware: Hardware
    console: Console
    shelf: Shelf
    """Where inputs are loaded, each once."""
    rank: int = 0
    world: int = 1
    """This process among those that share the stage's work."""
    watched_by: Sequence[Any] = ()
    """Lightning callbacks that stand in for a training's flight recorder: those of a replay."""
    again: RunState | None = None
    """How far the whole run is, where a stage is run outside of it (`motionloom report`); then inputs may be
    missing, and times may be shown. Within a run equal stages give equal outputs."""

    @property
    def units(self) -> Units:
        """The work that the processes divide."""
        return Units(self.folder / WORK, self.rank, self.world)

    @property
    def device(self) -> torch.device:
        """Where a stage computes that does not train, and where its inputs are loaded."""
        return self.shelf.device

    @property
    def given(self) -> Given:
        """What the inputs give, loaded on first use."""
        return self.shelf.given(self.inputs)

    def input(self, role: str) -> Path:
        """Folder of an input."""
        return self.inputs[role].folder

    def every(self, role: str) -> list[Finished]:
        """The stages of a role that is declared with `Every`, in the recipe's order."""
        return [stage for key, stage in self.inputs.items() if key.startswith(f"{role}.")]


class StageKind(ABC):
    """What one kind of stage answers. Subclasses set the attributes and override what applies to them."""

    name: str
    """In recipes: `kind: name`."""
    summary: str
    """A few words for people."""
    config: type[StageConfig]
    takes: tuple[str | Every, ...] = ()
    """Inputs: roles, with a trailing "?" for one that a recipe can do without, or `Every`. A role called
    otherwise than what fills it tells that behind a colon: "face_tokenizer?: tokenizer"."""
    version: int = 1
    """Raised when the same config makes something else than before."""
    trains: bool = False
    shares: bool = False
    """Whether all processes of a run take part by `share` before the first of them runs the stage."""

    def gives(self, config: Any) -> frozenset[str]:
        """Names of what other stages may ask of this one, such as "tokenizer" or `GENERATOR`."""
        return frozenset()

    def roles(self) -> tuple[Role | Every, ...]:
        """`takes`, parsed."""
        return tuple(one if isinstance(one, Every) else Role.parse(one) for one in self.takes)

    # Before and while it runs.

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:  # noqa: B027 (nothing to refuse)
        """Refuse, with a `UserError`, a combination with the recipe's other stages that cannot work."""

    def external(self, config: Any) -> Any:
        """Facts about files outside the run (names, sizes, checksums) that belong to the fingerprint."""
        return None

    def share(self, context: StageContext) -> None:  # noqa: B027 (most kinds have none)
        """Make this process's share of `context.units`, which `run` then reads and clears."""

    @abstractmethod
    def run(self, context: StageContext) -> None:
        """Make the stage's outputs in `context.folder`."""

    def settle(self, config: Any, folder: Path) -> None:  # noqa: B027 (most kinds have none)
        """Put RUNTIME settings into the folder of a finished stage, for the stages that read it."""

    # What it gives to other stages.

    def preview(self, config: Any, given: Given) -> Any:
        """What `load` will give, as far as it is known before the stage has run (dry runs)."""
        return None

    def load(self, stage: Finished, given: Given, device: torch.device) -> Any:
        """What the finished stage gives to those that take it."""
        return stage.folder

    def preview_of_finished(self, stage: Finished, given: Given) -> Any:
        """What `load` gives, for a dry run; a kind whose weights take long to read may leave them out."""
        return self.load(stage, given, CPU)

    def generator(self, stage: Finished, given: Given, device: torch.device) -> MotionGenerator:
        """A generator of motion, of a kind that gives `GENERATOR`."""
        raise NotImplementedError(f"stages of kind {self.name} generate nothing")

    def exported(self, config: Any) -> tuple[str, ...]:
        """Roles whose stages an export must take along for this stage to load."""
        return ()

    def exported_config(self, config: Any) -> Any:
        """The config as an export shows it to everybody."""
        return config

    def export(self, stage: Finished, target: Path) -> None:
        """Copy what loading needs into `target`, an empty folder."""
        raise UserError(f"{stage.folder}: a stage of kind {self.name} cannot be exported")

    # What a dry run and the report say of it.

    def estimate(self, config: Any, given: Given, hardware: Hardware) -> ModelCard | None:
        """Sizes of a kind that trains; None for the others."""
        return None

    def curves(self, config: Any) -> tuple[Curve, ...]:
        """Curves of the training log that are worth drawing."""
        return ()

    def show(self, stage: Finished, given: Given) -> list[Showing]:
        """Figures of the finished stage for the report, beside its curves."""
        return []


@dataclass
class FunctionStage(StageKind):
    """A kind that is one function; for stages that train nothing."""

    name: str
    summary: str
    config: type[StageConfig]
    function: Callable[[StageContext], None]
    takes: tuple[str | Every, ...] = ()
    version: int = 1
    trains: bool = False
    shares: bool = False
    given_names: frozenset[str] = field(default_factory=frozenset)

    def gives(self, config: Any) -> frozenset[str]:
        """As named at construction."""
        return self.given_names

    def run(self, context: StageContext) -> None:
        """Call the function."""
        self.function(context)


def _over(defaults: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """`given` with what it lacks of `defaults`, group by group."""
    out = {**defaults, **given}
    for name, value in given.items():
        if isinstance(value, dict) and isinstance(defaults.get(name), dict):
            out[name] = _over(defaults[name], value)
    return out
