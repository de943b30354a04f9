"""What pyproject.toml requires is what the packages import, no more and no less."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("configs", "datasets", "models", "pipeline")
CONFIG = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = CONFIG["project"]

# Imported by Lightning's loggers, which are what we import.
THROUGH_LIGHTNING = {"tensorboard", "wandb", "mlflow"}


def canonical(name: str) -> str:
    """A distribution's name as the package index compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def declared(requirements: list[str]) -> set[str]:
    return {canonical(re.split(r"[\s\[<>=!~;]", requirement)[0]) for requirement in requirements}


REQUIRED = declared(PROJECT["dependencies"])
OPTIONAL = {name for extra in PROJECT["optional-dependencies"].values() for name in declared(extra)}


class Imports(ast.NodeVisitor):
    """Top-level names that a file imports, at once (False) or inside a function (True)."""

    def __init__(self) -> None:
        self.found: set[tuple[str, bool]] = set()
        self._depth = 0

    def _function(self, node: ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) -> None:
        self._depth += 1
        self.generic_visit(node)
        self._depth -= 1

    visit_FunctionDef = visit_AsyncFunctionDef = visit_Lambda = _function  # noqa: N815

    def visit_Import(self, node: ast.Import) -> None:
        self.found.update((alias.name.split(".")[0], self._depth > 0) for alias in node.names)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        self.found.add(((node.module or "").split(".")[0], self._depth > 0))

    def visit_Call(self, node: ast.Call) -> None:
        """`find_spec("x")` looks for a package's files without importing it."""
        called = getattr(node.func, "id", getattr(node.func, "attr", ""))
        if called in ("find_spec", "import_module") and node.args and isinstance(node.args[0], ast.Constant):
            self.found.add((str(node.args[0].value).split(".")[0], True))
        self.generic_visit(node)


def uses() -> dict[tuple[str, bool], set[str]]:
    """(distribution, inside a function) -> files."""
    owners = packages_distributions()
    found: dict[tuple[str, bool], set[str]] = {}
    for path in sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        visitor = Imports()
        visitor.visit(ast.parse(path.read_text(encoding="utf-8")))
        for name, inside in visitor.found:
            if name == "motionloom" or name in sys.stdlib_module_names:
                continue
            for owner in owners.get(name, [name]):
                found.setdefault((canonical(owner), inside), set()).add(path.relative_to(ROOT).as_posix())
    return found


def test_every_import_is_declared() -> None:
    for (owner, inside), files in uses().items():
        allowed = REQUIRED | OPTIONAL if inside else REQUIRED
        where = "in a function" if inside else "at the top of the file"
        assert owner in allowed, f"{owner} is imported {where} by {sorted(files)}, but not declared for that"


def test_everything_declared_is_imported() -> None:
    imported = {owner for owner, _ in uses()}
    assert imported >= REQUIRED - THROUGH_LIGHTNING, (
        f"never imported: {REQUIRED - THROUGH_LIGHTNING - imported}"
    )
    assert imported >= OPTIONAL - THROUGH_LIGHTNING, f"never imported: {OPTIONAL - imported}"


def test_nothing_is_both_required_and_optional() -> None:
    assert not REQUIRED & OPTIONAL


def test_every_recipe_comes_with_the_package() -> None:
    configs = ROOT / "configs"
    taken = {
        path
        for glob in CONFIG["tool"]["setuptools"]["package-data"]["motionloom.configs"]
        for path in configs.glob(glob)
    }
    assert taken == {
        path for path in configs.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")
    }
