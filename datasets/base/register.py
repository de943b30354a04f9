"""Adding from outside: the tables by name, `register` and `declare`, and the packages that call them.

A package adds to the tables by an entry point of the group `motionloom.stages` that names a module, a lone
file by the environment variable `MOTIONLOOM_STAGES`, a comma-separated list of modules or files. The module
calls `register(thing)`, or `declare(table, {name: module})` for things whose modules are imported only when
their name is asked for. What neither paper needs is added so, too: motionloom has an entry point for each of
its folders behind the fence. Recipes, exports and data name no code: reading one runs nothing.
"""

from __future__ import annotations

import ast
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec, resolve_name
from pathlib import Path
from typing import Any, TypeVar

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of, sha256_of_json

GROUP = "motionloom.stages"
VARIABLE = "MOTIONLOOM_STAGES"

T = TypeVar("T")


class Table(Mapping[str, T]):
    """All things of one class by their names, to which `register` and `declare` add; with `classes`, its
    subclasses. A thing that was declared is imported when its name is looked up, or when all are listed.
    """

    def __init__(self, of: type, called: str, *, classes: bool = False) -> None:
        self.called = called
        self.classes = classes
        self.followers: list[Callable[[T], object]] = []
        self._things: dict[str, T] = {}
        _TABLES[of] = self

    def __getitem__(self, name: str) -> T:
        if name not in self:
            raise KeyError(name)
        if name not in self._things:
            self._import(name)
        return self._things[name]

    def __contains__(self, name: object) -> bool:
        if name not in self._things and name not in self._places:
            self._import_others()
        return name in self._things or name in self._places

    def __iter__(self) -> Iterator[str]:
        """What was registered without being declared first, then what is declared."""
        self._import_others()
        return iter({**{name: 0 for name in self._things if name not in self._places}, **self._places})

    def __len__(self) -> int:
        return sum(1 for _ in self)

    @property
    def _places(self) -> dict[str, str]:
        return _declared(self.called).places

    def _import_others(self) -> None:
        """Import what registers one thing of this table for each of another table."""
        others = _declared(self.called).others
        while others:
            import_module(others.pop())

    def _import(self, name: str) -> None:
        """Import the module that registers a declared name, or call the function that does."""
        module, _, function = self._places[name].partition(":")
        try:
            imported = import_module(module)
        except ModuleNotFoundError as error:
            raise UserError(f"{self.called} '{name}': {error}; install what {module} needs") from None
        if function:
            getattr(imported, function)(name)
        if name not in self._things:
            raise UserError(f"{module}: registers no {self.called} '{name}', which was declared of it")

    def imported(self) -> list[T]:
        """The things whose modules are imported already."""
        return list(self._things.values())

    def follow(self, do: Callable[[T], object]) -> None:
        """Call `do` with each thing that is imported and each that comes; a `UserError` of it refuses one."""
        for thing in list(self._things.values()):
            do(thing)
        self.followers.append(do)

    def add(self, name: str, thing: T) -> None:
        """Take in a thing; `UserError` where another one has its name."""
        if name in self._things:
            taken = self._things[name] is not thing
        else:
            # Only the module that a name was declared of registers it, and that one is being imported now.
            taken = name in self._places and self._places[name].partition(":")[0] not in sys.modules
        if taken:
            raise UserError(f"{self.called} '{name}': another one has this name; choose a new one")
        if name not in self._things:
            for do in self.followers:
                do(thing)
            self._things[name] = thing


@dataclass
class _Declared:
    """What was declared of a table, which may not be imported yet."""

    places: dict[str, str] = field(default_factory=dict)
    """Name -> module that registers it, or "module:function"."""
    others: list[str] = field(default_factory=list)
    """Modules that register a thing for each of another table."""


_TABLES: dict[type, Table[Any]] = {}
_DECLARED: dict[str, _Declared] = {}
"""By the titles of tables."""


def _declared(called: str) -> _Declared:
    return _DECLARED.setdefault(called, _Declared())


def declare(called: str, places: Mapping[str, str], others: Iterable[str] = ()) -> None:
    """Say which modules register things of a table, such as "stage kind".

    Args:
        called: The title of the table.
        places: Name of a thing -> module that registers it, or "module:function" that registers it by name.
        others: Modules that register things whose names are not known before, such as one for each of
            another table; they are imported when a name is not found, and before all are listed.

    Raises:
        UserError: A name is taken by another module.
    """
    known = _declared(called)
    for name, module in places.items():
        if known.places.setdefault(name, module) != module:
            raise UserError(f"{called} '{name}': {known.places[name]} has this name; choose a new one")
    known.others += others


def register(thing: T) -> T:
    """Add something of your own; recipes, files and the command line know it by its `name` from then on.

    `thing` is of a class that has a `Table` (`StageKind`, `ClipMetric`, `Modality`, `Writer`, `Command` and
    more), or a subclass of `Converter`. Returns it. Raises `UserError` where the name is taken, and where
    `thing` is none of these.
    """
    named: Any = thing
    classes = isinstance(named, type)
    bases = named.__mro__ if classes else type(named).__mro__
    table = next((_TABLES[base] for base in bases if base in _TABLES), None)
    if table is None or table.classes != classes:
        known = ", ".join(one.called + " (its class)" * one.classes for one in _TABLES.values())
        raise UserError(f"register: {named!r} is nothing that can be added; known: {known}")
    table.add(named.name, thing)
    return thing


@cache
def discover() -> None:
    """Import the modules that register or declare something, each once. `UserError` names a package or module
    that cannot be imported.
    """
    for point in entry_points(group=GROUP):
        if not _left_out(point.module):
            _import(point.module, f"{distribution_of(point.module)}: entry point {point.value}", "update it")
    for name in filter(None, map(str.strip, os.environ.get(VARIABLE, "").split(","))):
        if name.endswith(".py"):
            # Loader workers get the path and import the file by its name, too.
            sys.path.append(str(Path(name).absolute().parent))
        module = Path(name).stem if name.endswith(".py") else name
        _import(module, f"{VARIABLE}={name}", "name a file, or a module on the path")


def _left_out(module: str) -> bool:
    """Whether somebody has taken a folder of ours out of the installation, which all others work without."""
    package = module.rpartition(".")[0]
    return module.startswith("motionloom.") and find_spec(package) is None


def _import(module: str, where: str, fix: str) -> None:
    try:
        import_module(module)
    except ImportError as error:
        raise UserError(f"{where}: cannot be imported ({error}); {fix}") from None


def distribution_of(module: str) -> str:
    """`name==version` of the distribution with an entry point in a module's package; else the module."""
    top = module.partition(".")[0]
    found = (point.dist for point in entry_points(group=GROUP) if point.module.partition(".")[0] == top)
    dist = next(found, None)
    return module if dist is None else f"{dist.name}=={dist.version}"


def code_of(modules: Iterable[str]) -> dict[str, str]:
    """sha256 of the code of those modules that are neither motionloom's nor Python's, by their names.

    A module's code is its file, and those of its package that it imports, by others or within functions too.
    What a notebook or a prompt defines has none.
    """
    out = {}
    for name in sorted(set(modules)):
        if name.partition(".")[0] not in {"motionloom", *sys.stdlib_module_names} and (files := _files(name)):
            out[name] = sha256_of_json({module: sha256_of(file) for module, file in files.items()})
    return out


def _files(name: str) -> dict[str, Path]:
    """The files of a module and of what it imports of its package, by the names of the modules."""
    top = name.partition(".")[0]
    package = sys.modules.get(top)
    folders = [Path(folder) for folder in getattr(package, "__path__", ())]
    if not folders:
        file = getattr(package, "__file__", None)
        return {} if file is None else {name: Path(file)}
    found: dict[str, Path] = {}
    todo = [name]
    while todo:
        module = todo.pop()
        bases = [folder.joinpath(*module.split(".")[1:]) for folder in folders]
        places = [place for base in bases for place in (base / "__init__.py", base.with_suffix(".py"))]
        place = next((place for place in places if place.is_file()), None)
        if module in found or place is None:  # None: what is imported from a module is no module
            continue
        found[module] = place
        inside = module if place.name == "__init__.py" else module.rpartition(".")[0]
        for node in ast.walk(ast.parse(place.read_bytes(), str(place))):
            if isinstance(node, ast.Import):
                todo += [one.name for one in node.names if one.name.partition(".")[0] == top]
            elif isinstance(node, ast.ImportFrom):
                base = resolve_name("." * node.level + (node.module or ""), inside)
                if base.partition(".")[0] == top:
                    todo += [base, *(f"{base}.{one.name}" for one in node.names)]
    return found
