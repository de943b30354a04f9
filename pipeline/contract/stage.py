"""The interface of stage kinds, through which all other code asks about them: nothing else lists kinds.

A kind declares its inputs and outputs, runs, and loads what it made. Kinds that train have further methods
(`training/trained_stage.py`). The graph, the dry run, exports, `generate`, `evaluate` and the report use this
interface alone; a new kind implements it in its own file and is registered by one line.

`register(MyStage())` adds a kind, ours and others'; `datasets/base/register.py` says where that line stands.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar

import torch
from pydantic import BaseModel, model_validator
from rich.console import Console

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.register import VARIABLE, Table, discover
from motionloom.datasets.base.register import register as register
from motionloom.pipeline.contract.generation import MotionGenerator
from motionloom.pipeline.contract.inputs import Every as Every
from motionloom.pipeline.contract.inputs import Inputs as Inputs
from motionloom.pipeline.contract.inputs import MissingInputError as MissingInputError
from motionloom.pipeline.contract.inputs import Role as Role
from motionloom.pipeline.contract.inputs import filled_by as filled_by
from motionloom.pipeline.contract.showing import Curve, ModelCard, Showing
from motionloom.pipeline.contract.units import WORK, Units
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.store.artifact import require_unchanged
from motionloom.pipeline.store.yaml import require_counts

if TYPE_CHECKING:
    from motionloom.pipeline.contract.captioning import MotionCaptioner

CPU = torch.device("cpu")

GENERATOR = "generator"
"""Offered by stages that make motion: `StageKind.generator`."""

CAPTIONER = "captioner"
"""Offered by stages that caption motions: `StageKind.captioner`."""

ALIGNMENT = "alignment"
"""Offered by stages that embed text and motion in one space: they load as a `LoadedTma`."""

FACE_ALIGNMENT = "face_alignment"
"""Offered by stages that embed captions of faces and expressions in one space."""

SHOWING = "showing"
"""Offered by stages that have curves or figures for the report."""


class NotThereError(UserError):
    """The folder that a field of a stage's config names is not there."""

    def __init__(self, message: str, field: str) -> None:
        super().__init__(message)
        self.field = field


class StageConfig(Config):
    """Base of every stage's config."""

    @model_validator(mode="before")
    @classmethod
    def _keep_defaults(cls, data: object) -> object:
        """Fill a partly given group of settings with the stage's own defaults."""
        if not isinstance(data, dict):
            return data
        out = dict(data)
        for name, info in cls.model_fields.items():
            if isinstance(info.default, BaseModel) and isinstance(out.get(name), dict):
                out[name] = _filled(info.default, out[name])
        return out

    @model_validator(mode="after")
    def _counted(self) -> Self:
        require_counts(self.model_dump())
        return self

    def require_fit(self, hardware: Hardware) -> None:
        """Refuse, before anything runs, settings that cannot run on this hardware."""


C = TypeVar("C", bound=StageConfig)


@dataclass(frozen=True)
class Stage:
    """One stage of a resolved recipe. `inputs` maps roles to stage names, or to places outside the run."""

    name: str
    kind: StageKind
    config: Any
    inputs: dict[str, str]


@dataclass(frozen=True)
class CompletedStage:
    """A completed stage and those that fed it."""

    name: str
    kind: StageKind
    config: Any
    folder: Path
    inputs: Mapping[str, CompletedStage]
    exported: bool = False
    """In an exported folder, which may come from anywhere: nothing outside `folder` is followed."""
    outside: bool = False
    """Whether it belongs to another run or to an export; then `name` names both."""

    def gives(self, what: str) -> bool:
        """Whether it offers `what` to other stages."""
        return what in self.kind.gives(self.config)

    def upstream(self) -> Iterator[CompletedStage]:
        """All stages above this one, each once, those it reads first."""
        seen: set[Path] = set()
        todo = list(self.inputs.values())
        while todo:
            stage = todo.pop(0)
            if stage.folder not in seen:
                seen.add(stage.folder)
                yield stage
                todo += stage.inputs.values()


class StageCache:
    """Completed stages, each loaded once, all on one device. A caller's own draws stay what they are."""

    def __init__(self, device: torch.device = CPU) -> None:
        self.device = device
        self._loaded: dict[Path, object] = {}

    @torch.random.fork_rng(devices=[])
    def get(self, stage: CompletedStage) -> Any:
        if stage.folder not in self._loaded:
            require_unchanged(stage.folder)
            self._loaded[stage.folder] = stage.kind.load(stage, self.given(stage.inputs), self.device)
        return self._loaded[stage.folder]

    def given(self, inputs: Mapping[str, CompletedStage]) -> Inputs:
        return Inputs({role: partial(self.get, stage) for role, stage in inputs.items()})

    @torch.random.fork_rng(devices=[])
    def generator(self, stage: CompletedStage) -> MotionGenerator:
        require_unchanged(stage.folder)
        return stage.kind.generator(stage, self.given(stage.inputs), self.device)

    @torch.random.fork_rng(devices=[])
    def captioner(self, stage: CompletedStage) -> MotionCaptioner:
        require_unchanged(stage.folder)
        return stage.kind.captioner(stage, self.given(stage.inputs), self.device)


def _nothing() -> None:
    pass


@dataclass(frozen=True)
class StageContext:
    """The arguments of a stage's `run`. `inputs` maps each role to a finished stage."""

    name: str
    recipe: str
    """Name of the recipe, for people."""
    config: Any
    folder: Path
    """Its output folder, with the checkpoints from which a training is resumed."""
    inputs: Mapping[str, CompletedStage]
    seed: int
    hardware: Hardware
    console: Console
    stage_cache: StageCache
    """Loads each input once."""
    rank: int = 0
    world: int = 1
    """This process among those that share the stage's work."""
    again: Path | None = None
    """The run, where a stage is run outside of it, finished or not (`motionloom report`); then inputs may be
    missing, and times may be shown. Within a run equal stages give equal outputs."""
    draws: tuple[str, ...] = ()
    """Command that draws motions while it trains, to be given the run and the stage; empty where none can be
    drawn."""
    begun: Callable[[], None] = _nothing
    """Called by a training once its checkpoint has been loaded: until then the folder says what it said."""
    saved: Callable[[], None] = _nothing
    """Called by the lead when another checkpoint is on disk."""

    @property
    def units(self) -> Units:
        return Units(self.folder / WORK, self.rank, self.world)

    @property
    def device(self) -> torch.device:
        """Where a stage computes that does not train, and where its inputs are loaded."""
        return self.stage_cache.device

    @property
    def given(self) -> Inputs:
        """The inputs by role, each loaded when it is first read."""
        return self.stage_cache.given(self.inputs)

    def input(self, role: str) -> Path:
        """The folder of the stage in a role."""
        return self.inputs[role].folder

    def every(self, role: str) -> list[CompletedStage]:
        """The stages of a role that is declared with `Every`, in the recipe's order."""
        return [stage for key, stage in self.inputs.items() if key.startswith(f"{role}.")]


class StageKind(ABC, Generic[C]):
    """Base of stage kinds. Subclasses set the attributes and override what applies to them.

    `config` is the stage's own, `given` its loaded inputs by role. Where a method cannot go on it raises a
    `UserError` of one sentence that says what to change.
    """

    name: str
    """Its name in recipes: `kind: name`."""
    summary: str
    """A few words for people."""
    config: type[C]
    """Its fields are the keys of the stage in a recipe."""
    takes: tuple[str | Every, ...] = ()
    """Inputs: roles, with a trailing "?" if optional, or `Every`. The kind that fills a role of another name
    stands behind a colon: "face_tokenizer?: tokenizer"."""
    offers: frozenset[str] = frozenset()
    """Names of its outputs for other stages, such as "tokenizer" or `GENERATOR`."""
    exports: tuple[str, ...] = ()
    """Roles whose stages an export must take along for this stage to load."""
    version: int = 1
    """Increased when the same config gives another output than before."""
    trains: bool = False
    """Whether `run` is a training, in which all processes of a run take part."""
    curves: tuple[Curve, ...] = ()
    """Columns of its training log that the report draws."""
    shares: bool = False
    """Whether all processes of a run take part by `share` before the first of them runs the stage."""
    light: bool = False
    """Whether no processes are started for a kind that shares where nothing else wants them."""
    parts: bool = False
    """Whether `run` can make the part `hardware.part` alone, beside others; of a kind without inputs."""

    @property
    def heavy(self) -> bool:
        """Whether all processes and GPUs are wanted for it."""
        return self.trains or (self.shares and not self.light)

    def gives(self, config: C) -> frozenset[str]:
        """`offers`, where the config does not say otherwise."""
        return self.offers

    def roles(self) -> tuple[Role | Every, ...]:
        """`takes`, parsed."""
        return tuple(one if isinstance(one, Every) else Role.parse(one) for one in self.takes)

    def modules(self, config: C) -> Iterable[str]:
        """Return the modules that decide its output: the code of those outside of motionloom is part of the
        fingerprint (`register.code_of`). A kind without any has its `version` alone.
        """
        return [base.__module__ for base in type(self).__mro__ if issubclass(base, StageKind)]

    # Before and while it runs.

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:
        """Refuse, with a `UserError`, a combination with the recipe's other stages that cannot work."""

    def external(self, config: C) -> object:
        """Facts of files outside the run, for the fingerprint; a `NotThereError` is told with its `--set`."""
        return None

    def share(self, context: StageContext) -> None:
        """Make this process's share of `context.units`, which `run` then reads and clears."""

    @abstractmethod
    def run(self, context: StageContext) -> None:
        """Make the stage's outputs in `context.folder`; later its files are compared with their sha256."""

    def settle(self, config: C, folder: Path) -> None:
        """Put RUNTIME settings into the folder of a finished stage, for the stages that read it."""

    # What it gives to other stages.

    def preview(self, config: C, given: Inputs) -> object:
        """Return what `load` will return, as far as it is known before the stage has run (dry runs)."""
        return None

    def load(self, stage: CompletedStage, given: Inputs, device: torch.device) -> object:
        """Return the completed stage's output, for the stages that take it; tensors on `device`."""
        return stage.folder

    def preview_of_finished(self, stage: CompletedStage, given: Inputs) -> object:
        """Return the output of `load` for a dry run; a kind with large weights may leave them out."""
        return self.load(stage, given, CPU)

    def generator(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionGenerator:
        """A generator of motion, of a kind that gives `GENERATOR`."""
        raise NotImplementedError(f"stages of kind {self.name} generate nothing")

    def captioner(self, stage: CompletedStage, given: Inputs, device: torch.device) -> MotionCaptioner:
        """Return a captioner, of a kind that offers `CAPTIONER`."""
        raise NotImplementedError(f"stages of kind {self.name} say nothing")

    def exported(self, config: C) -> tuple[str, ...]:
        """`exports`, where the config does not say otherwise."""
        return self.exports

    def exported_config(self, config: C) -> C:
        """The config as an export shows it to everybody."""
        return config

    def export(self, stage: CompletedStage, target: Path) -> None:
        """Copy what `load` and `generator` need into the folder `target`, which may have to be made."""
        raise UserError(f"{stage.folder}: a stage of kind {self.name} cannot be exported")

    # What a dry run and the report say of it.

    def require_inputs(self, config: C, given: Inputs) -> None:
        """Refuse, with a `UserError`, previews of inputs that a stage of these settings cannot work with."""

    def estimate(self, config: C, given: Inputs, hardware: Hardware) -> ModelCard | None:
        """Sizes of a kind that trains; None for the others."""
        return None

    def show(self, stage: CompletedStage, given: Inputs) -> list[Showing]:
        """Figures of the finished stage for the report, beside its curves."""
        return []


@dataclass
class FunctionStage(StageKind):
    """A kind that is one function; for stages that train nothing. Its output is `context.folder`."""

    name: str
    summary: str
    config: type[StageConfig]
    function: Callable[[StageContext], None]
    takes: tuple[str | Every, ...] = ()
    version: int = 1
    trains: bool = False
    shares: bool = False
    offers: frozenset[str] = frozenset()

    def modules(self, config: StageConfig) -> Iterable[str]:
        return [*super().modules(config), self.function.__module__]

    def run(self, context: StageContext) -> None:
        self.function(context)


def _filled(defaults: BaseModel, given: dict[str, object]) -> dict[str, object]:
    """`given` with what it lacks of what the defaults set, group by group; what neither sets stays unset."""
    set_by_stage = defaults.model_dump(mode="json", include=defaults.model_fields_set)
    out = {**set_by_stage, **given}
    for name, value in given.items():
        inner = getattr(defaults, name, None)
        if isinstance(value, dict) and isinstance(inner, BaseModel):
            out[name] = _filled(inner, value)
    return out


# The table of kinds.

KINDS: Table[StageKind] = Table(StageKind, "stage kind")


def stage_kinds() -> Mapping[str, StageKind]:
    """All kinds by name, those of other packages included."""
    discover()
    return KINDS


def stage_kind(name: str, where: str, packages: Iterable[str] = ()) -> StageKind:
    """A kind by name; `where` is what names it, and `packages` gave it where it was made, for the message."""
    kinds = stage_kinds()
    install = ", ".join(packages)
    if name not in kinds:
        raise UserError(
            f"{where}: stage kind '{name}' is not known here; {f'install {install}, or ' if install else ''}"
            f"name the module that registers it in {VARIABLE}"
        )
    return kinds[name]
