"""Adding from outside: the tables by name, `register`, and the packages and files that call it.

A package adds to the tables by an entry point of the group `motionloom.stages` that names a module, a lone
file by the environment variable `MOTIONLOOM_STAGES`, a comma-separated list of modules or files. The module
calls `register(thing)`. Recipes, exports and data name no code: reading one runs nothing.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeVar

from motionloom.datasets.base.files import sha256_of, sha256_of_json
from motionloom.datasets.schema import UserError

GROUP, VARIABLE = "motionloom.stages", "MOTIONLOOM_STAGES"

T = TypeVar("T")


class Table(dict[str, T]):
    """All things of one class by their names, to which `register` adds; with `classes`, its subclasses."""

    def __init__(self, of: type, called: str, *, classes: bool = False) -> None:
        super().__init__()
        self.called, self.classes = called, classes
        self._followers: list[Callable[[T], object]] = []
        _TABLES[of] = self

    def follow(self, do: Callable[[T], object]) -> None:
        """Call `do` with each thing that is there and each that comes; a `UserError` of it refuses one."""
        for thing in list(self.values()):
            do(thing)
        self._followers.append(do)

    def enter(self, name: str, thing: T) -> None:
        """Add a thing; `UserError` where another one has its name."""
        if self.get(name, thing) is not thing:
            raise UserError(f"two {self.called}s are called '{name}'; rename one of them")
        if name not in self:
            for do in self._followers:
                do(thing)
            self[name] = thing


_TABLES: dict[type, Table[Any]] = {}


def register(thing: T) -> T:
    """Add something of your own; recipes, files and the command line know it by its `name` from then on.

    `thing` is a `StageKind`, a `ClipMetric`, a `Modality`, a `Writer`, or a class of `Converter`. Returns it.
    Raises `UserError` where the name is taken, and where `thing` is none of these.
    """
    named: Any = thing
    classes = isinstance(named, type)
    bases = named.__mro__ if classes else type(named).__mro__
    table = next((_TABLES[base] for base in bases if base in _TABLES), None)
    if table is None or table.classes != classes:
        known = ", ".join(one.called + " (its class)" * one.classes for one in _TABLES.values())
        raise UserError(f"register: {named!r} is nothing that can be added; known: {known}")
    table.enter(named.name, thing)
    return thing


@cache
def discover(*, ours: bool = False) -> None:
    """Import the modules that register something, each once; with `ours` motionloom's own kinds of stages
    too, which bring in torch. `UserError` names a package or module that cannot be imported.
    """
    for point in entry_points(group=GROUP):
        if ours or not point.module.startswith("motionloom."):
            _import(point.module, f"{distribution_of(point.module)}: entry point {point.value}", "update it")
    for name in filter(None, map(str.strip, os.environ.get(VARIABLE, "").split(","))):
        if name.endswith(".py"):
            # Loader workers get the path and import the file by its name, too.
            sys.path.append(str(Path(name).absolute().parent))
        module = Path(name).stem if name.endswith(".py") else name
        _import(module, f"{VARIABLE}={name}", "name a file, or a module on the path")


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

    The code of a module in a package is every `.py` file of its folder and of the packages within it, of any
    other its own file; what a notebook or a prompt defines has none.
    """
    out = {}
    for name in sorted(set(modules)):
        file = getattr(sys.modules.get(name), "__file__", None)
        if file is None or name.partition(".")[0] in {"motionloom", *sys.stdlib_module_names}:
            continue
        place = Path(file)
        packaged = "." in name or place.name == "__init__.py"
        files = _files(place.parent) if packaged else [place]
        out[name] = sha256_of_json({str(path.relative_to(place.parent)): sha256_of(path) for path in files})
    return out


def _files(folder: Path) -> list[Path]:
    packages = (path.parent for path in folder.glob("*/__init__.py"))
    return [*folder.glob("*.py"), *(path for package in packages for path in _files(package))]
