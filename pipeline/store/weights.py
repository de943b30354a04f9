"""Trained networks on disk: `model.safetensors`, and `model.json` with all that building them needs.

Also weights that others published, under their names for what is ours (`Release`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TypeVar

import torch
from pydantic import Field, PrivateAttr
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch.nn.modules.module import (
    register_module_buffer_registration_hook,
    register_module_module_registration_hook,
    register_module_parameter_registration_hook,
)

from motionloom.datasets.base.config import Config, FrameRate
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import atomic_path
from motionloom.datasets.base.json_doors import require_plain
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.store.files import write_json

Fact = TypeVar("Fact")
N = TypeVar("N", bound=torch.nn.Module)

MODEL_FILES = ("model.safetensors", "model.json")
"""The files of a trained network."""


class LayoutFacts(Config):
    """The arguments of `MotionLayout.named` for a layout."""

    name: str
    fps: FrameRate
    family: str

    @staticmethod
    def of(layout: MotionLayout) -> LayoutFacts:
        return LayoutFacts(name=layout.name, fps=layout.fps, family=layout.family)

    def layout(self) -> MotionLayout:
        return MotionLayout.named(self.name, fps=self.fps, family=self.family)  # type: ignore[arg-type]


class ModelFacts(Config):
    """`model.json`."""

    kind: str
    config: dict[str, object]
    layout: LayoutFacts
    extra: dict[str, object] = Field(default_factory=dict)
    _where: str = PrivateAttr("model.json")

    @staticmethod
    def of(
        kind: str, net: Config, layout: MotionLayout, extra: Mapping[str, object] | None = None
    ) -> ModelFacts:
        """Facts of a network of sizes `net` for motion in `layout`."""
        return ModelFacts(
            kind=kind, config=net.dump(), layout=LayoutFacts.of(layout), extra=dict(extra or {})
        )

    def fact(self, key: str, kind: type[Fact]) -> Fact:
        """A fact in `extra`, of the kind it must be."""
        value = self.extra.get(key)
        if not isinstance(value, kind):
            missing = "is required" if key not in self.extra else f"= {value!r:.60} is no {kind.__name__}"
            raise UserError(f"{self.where}: key 'extra.{key}' {missing}; run or export the stage again")
        return value

    @property
    def where(self) -> str:
        return self._where


def save_model(folder: Path, net: torch.nn.Module, facts: ModelFacts) -> None:
    """Write weights and facts; the facts last."""
    state = {k: v.detach().contiguous().cpu() for k, v in net.state_dict().items()}
    with atomic_path(folder / "model.safetensors") as temporary:
        temporary.write_bytes(save(state))
    write_json(folder / "model.json", facts.dump())


def halve_weights(path: Path) -> None:
    """Write a file of weights again in half precision, 16 bits a number; networks compute in 32 all the same.

    What half precision has no room for (beyond 65,504) stays as it is, and so does what is no number.
    """
    largest = torch.finfo(torch.float16).max
    state = {
        name: value.half() if value.dtype == torch.float32 and bool((value.abs() <= largest).all()) else value
        for name, value in load_file(path).items()
    }
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(state))


def load_facts(folder: Path) -> ModelFacts:
    """Facts of the network in a folder."""
    facts = ModelFacts.load_json(folder / "model.json")
    facts._where = str(folder / "model.json")
    return facts


class _TooLargeError(Exception):
    """A network outgrows the weights that it is to be filled with."""


_TABLE = 2**24
"""Numbers that a table may have which a network makes for itself, such as one of positions."""
_PARTS = 64
"""Modules that a network has for each of its tensors, at most."""
_BUILDING: ContextVar[Path | None] = ContextVar("building", default=None)
"""The weights whose network is built, which may load the network of another stage meanwhile."""


def built(folder: Path, build: Callable[[], N]) -> N:
    """The network that the facts in `folder` ask for; refused where the weights there are of a smaller one.

    Construction is given up as soon as there are more parts than in the file, or one larger than any there.
    Most parts are filled after they are registered, so that until then their memory is only reserved.
    """
    path = folder / "model.safetensors"
    try:
        require_plain(path)
        with safe_open(path, "pt") as file:
            sizes = [torch.Size(file.get_slice(name).get_shape()).numel() for name in list(file.keys())]
    except (OSError, SafetensorError) as error:
        raise UserError(f"{path}: cannot be read as weights ({error}); copy the folder again") from None
    # Sizes come from the file alone: a hostile config must not reserve memory that the weights do not fill.
    largest = max(sizes, default=0)
    modules = 0
    parameters = dict[int, torch.nn.Parameter]()

    def weighed(_: torch.nn.Module, name: str, part: torch.nn.Parameter | None) -> None:
        if part is not None and _BUILDING.get() == path:
            parameters[id(part)] = part
            if len(parameters) > len(sizes) or part.numel() > largest:
                raise _TooLargeError

    def kept(_: torch.nn.Module, name: str, part: torch.Tensor | None) -> None:
        if part is not None and _BUILDING.get() == path and part.numel() > max(largest, _TABLE):
            raise _TooLargeError

    def counted(_: torch.nn.Module, name: str, part: torch.nn.Module | None) -> None:
        nonlocal modules
        modules += _BUILDING.get() == path
        if modules > _PARTS * (len(sizes) + 1):
            raise _TooLargeError

    hooks = (
        register_module_parameter_registration_hook(weighed),
        register_module_buffer_registration_hook(kept),
        register_module_module_registration_hook(counted),
    )
    # Hooks are global to torch, and another network may be loaded while this one is built.
    building = _BUILDING.set(path)
    try:
        return build()
    except (_TooLargeError, RuntimeError, OverflowError, MemoryError):
        raise UserError(
            f"{folder / 'model.json'}: asks for another network than {path.name} holds; copy the folder "
            f"again, or run the stage that made it again"
        ) from None
    finally:
        _BUILDING.reset(building)
        for hook in hooks:
            hook.remove()


@dataclass(frozen=True)
class Rows:
    """Some of the `of` rows of a tensor, in this order."""

    name: str
    rows: tuple[int, ...]
    of: int


@dataclass(frozen=True)
class Joined:
    """Tensors of equal shapes, one below the other."""

    names: tuple[str, ...]


Source = str | Rows | Joined
"""Where a tensor of ours lies in a release: in one of its shape (axes of length 1 aside), in some rows of
one, or in several."""


@dataclass(frozen=True)
class Release:
    """The names of published weights, for a network of ours (`TrainedStage.release`)."""

    names: Mapping[str, Source]
    """Name of each tensor in the network's state -> where it lies. What is not named stays as it was made;
    parameters must be."""
    unread: tuple[str, ...] = ()
    """Patterns (`*`, `?`) of tensors that may lie there and are of no use, such as tables of positions."""
    fix: str = "take weights of this size of the model, or set the stage's net as theirs are"
    """Ends the message of what is refused."""

    def fill(self, path: Path, net: torch.nn.Module) -> None:
        """Load a release's safetensors into `net`; a `UserError` names file, tensor and both shapes."""
        own = net.state_dict()
        lacking = dict(net.named_parameters()).keys() - self.names.keys()
        assert not lacking, f"no published name for {sorted(lacking)}"
        shapes: dict[str, tuple[int, ...]] = {}
        for name, source in self.names.items():
            shape = tuple(own[name].shape)
            if isinstance(source, Rows):
                shapes[source.name] = (source.of, *shape[1:])
            elif isinstance(source, Joined):
                shapes |= dict.fromkeys(source.names, (shape[0] // len(source.names), *shape[1:]))
            else:
                shapes[source] = shape
        found = exact_tensors(path, shapes, self.fix, self.unread)
        net.load_state_dict(own | {name: _taken(found, source) for name, source in self.names.items()})


def _taken(found: Mapping[str, torch.Tensor], source: Source) -> torch.Tensor:
    if isinstance(source, Rows):
        return found[source.name][list(source.rows)]
    if isinstance(source, Joined):
        return torch.cat([found[name] for name in source.names])
    return found[source]


def exact_tensors(
    path: Path, shapes: Mapping[str, tuple[int, ...]], fix: str, unread: tuple[str, ...] = ()
) -> dict[str, torch.Tensor]:
    """The tensors of a file as float32: exactly those of `shapes` (axes of length 1 aside), all finite.

    `fix` ends the message of what is refused; tensors that match a pattern of `unread` are passed over.
    """
    try:
        require_plain(path)
        found = load_file(path)
    except (OSError, SafetensorError, RuntimeError, MemoryError) as error:
        raise UserError(f"{path}: cannot be read ({' '.join(str(error).split())[:200]}); {fix}") from None
    idle = {name for name in found.keys() - shapes.keys() if any(fnmatchcase(name, one) for one in unread)}
    for name in sorted((shapes.keys() | found.keys()) - idle):
        shape = list(found[name].shape) if name in found else None
        wanted = list(shapes[name]) if name in shapes else None
        if shape is None or wanted is None or _without_ones(shape) != _without_ones(wanted):
            here, there = ("no tensor" if one is None else one for one in (shape, wanted))
            raise UserError(f"{path}: tensor '{name}' is {here}, and the published one {there}; {fix}")
    return {
        name: _as_type(found[name], torch.float32, f"{path}: tensor '{name}'", fix).reshape(shape)
        for name, shape in shapes.items()
    }


_FLOATS = (torch.float32, torch.float16, torch.bfloat16, torch.float64)
"""Types of weights; of eight bits they are nothing without the scales that quantised releases keep apart."""


def _as_type(value: torch.Tensor, to: torch.dtype, where: str, fix: str) -> torch.Tensor:
    """A tensor as a network has it, one float type as another; finite afterwards, as 1e308 is no float32."""
    if value.dtype != to and not {value.dtype, to} <= {*_FLOATS}:
        raise UserError(f"{where} is of {value.dtype}, not {to} or another float type; {fix}")
    made = value.to(to)
    if made.is_floating_point() and not bool(made.isfinite().all()):
        raise UserError(f"{where} holds numbers that are not finite; {fix}")
    return made


def _without_ones(shape: list[int]) -> list[int]:
    return [size for size in shape if size != 1]


def load_weights(folder: Path, net: torch.nn.Module) -> None:
    """Fill `net`; a file that does not fit is refused by name."""
    path = folder / "model.safetensors"
    try:
        require_plain(path)
        own = net.state_dict()
        fix = "run its stage again"
        net.load_state_dict(
            {
                name: _as_type(value, own[name].dtype, f"{path}: '{name}'", fix) if name in own else value
                for name, value in load_file(path).items()
            }
        )
    except (FileNotFoundError, MemoryError, SafetensorError, RuntimeError) as error:
        why = " ".join(str(error).split())[:300]
        raise UserError(
            f"{path}: cannot load these weights; were they made by another version? Run the stage that made "
            f"them again ({why})"
        ) from None
