"""The inputs of a stage: roles, and the loaded stages that fill them."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

from motionloom.datasets.base.errors import UserError


class _Kind(Protocol):
    """A kind of stage (`contract/stage.py`)."""

    name: str

    def gives(self, config: Any) -> frozenset[str]: ...


@dataclass(frozen=True)
class Role:
    """An input of a stage, filled by the stage of the same name unless the recipe names another."""

    name: str
    optional: bool
    gives: str
    """Name of the kind that fills it (or a subclass), or of something that stages give."""

    @staticmethod
    def parse(text: str) -> Role:
        """Parse an entry of `takes`: "stats", "tma?", "face_tokenizer?: tokenizer"."""
        left, _, gives = text.partition(":")
        name = left.strip().removesuffix("?")
        return Role(name, left.strip().endswith("?"), gives.strip() or name)

    def fits(self, kind: _Kind, config: object) -> bool:
        """Whether a stage of this kind and config may fill it."""
        names = {kind.name, *(vars(base).get("name") for base in type(kind).__mro__)}
        return self.gives in names or self.gives in kind.gives(config)


@dataclass(frozen=True)
class Every:
    """An input filled by every other stage that gives something, or by those the recipe lists, in order."""

    name: str
    gives: str
    needed: bool = False
    """Whether the stage is of no use without one."""
    optional: ClassVar[bool] = True

    def key(self, stage: str) -> str:
        """Return the key of one such stage among the inputs."""
        return f"{self.name}.{stage}"


class MissingInputError(UserError, KeyError):
    """A role that is read has no finished stage."""

    def __str__(self) -> str:
        return str(self.args[0])


class Inputs(Mapping[str, Any]):
    """The loaded inputs of a stage, by role; each is loaded when it is first read.

    A stage that trains declares its inputs as a subclass: a role is an annotated attribute, optional if its
    type allows None. `filled_by` names the kind that fills a role of another name.

        class GptInputs(Inputs):
            text: TextSource
            tma: LoadedTma | None
            start: LoadedGpt | None = filled_by("gpt")
    """

    def __init__(self, makers: Mapping[str, Callable[[], object]]) -> None:
        self._makers = dict(makers)
        self._made: dict[str, object] = {}
        self.work: Path | None = None
        """Folder for what the processes of a training make of them once; None without one."""

    @classmethod
    def roles(cls) -> tuple[Role, ...]:
        """The roles that a subclass declares, in order."""
        found = []
        for base in reversed(cls.__mro__):
            annotations = inspect.get_annotations(base) if issubclass(base, Inputs) else {}
            for name, annotation in annotations.items():
                declared = getattr(cls, name, None)
                what = declared.what if isinstance(declared, _FilledBy) else name
                found.append(Role(name, str(annotation).endswith("| None"), what))
        return tuple(found)

    @classmethod
    def of(cls, inputs: Inputs) -> Self:
        """Return the inputs as an instance of this class."""
        if isinstance(inputs, cls):
            return inputs
        made = cls(inputs._makers)
        made._made = inputs._made  # what one has loaded, the other need not load
        return made

    if not TYPE_CHECKING:  # there, only what a subclass annotates

        def __getattr__(self, name: str) -> object:
            """A declared role; None if it is optional and nothing fills it."""
            for role in type(self).roles():
                if role.name == name:
                    return self.get(name) if role.optional else self[name]
            raise AttributeError(name)

    def __getitem__(self, role: str) -> Any:
        if role not in self._makers:
            raise MissingInputError(f"no finished '{role}' stage here; run the recipe to the end first")
        if role not in self._made:
            self._made[role] = self._makers[role]()
        return self._made[role]

    def __contains__(self, role: object) -> bool:
        return role in self._makers

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)


class _FilledBy:
    """A role that does not have the name of the kind that fills it."""

    def __init__(self, what: str) -> None:
        self.what = what
        self.name = ""

    def __set_name__(self, owner: type[Inputs], name: str) -> None:
        self.name = name

    def __get__(self, inputs: Inputs | None, owner: type[Inputs]) -> object:
        return self if inputs is None else inputs.get(self.name)


def filled_by(what: str) -> Any:
    """Declare an optional role for stages of kind `what`, or that give `what`."""
    return _FilledBy(what)
