"""Adding from outside: the tables by name, `register`, and the packages and files that call it.

A package adds to the tables by an entry point of the group `motionloom.stages` that names a module, a lone
file by the environment variable `MOTIONLOOM_STAGES`, a comma-separated list of modules or files. The module
calls `register(thing)`. Recipes, exports and data name no code: reading one runs nothing.
"""

from __future__ import annotations

import ast
import os
import sys
from collections.abc import Callable, Iterable
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import resolve_name
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
        self.followers: list[Callable[[T], object]] = []
        _TABLES[of] = self

    def follow(self, do: Callable[[T], object]) -> None:
        """Call `do` with each thing that is there and each that comes; a `UserError` of it refuses one."""
        for thing in list(self.values()):
            do(thing)
        self.followers.append(do)


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
    if table.get(named.name, thing) is not thing:
        raise UserError(f"{table.called} '{named.name}': another one has this name; choose a new one")
    if named.name not in table:
        for do in table.followers:
            do(thing)
        table[named.name] = thing
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
