"""The import arrows between the folders (docs/architecture.md), and the packaging list."""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("configs", "datasets", "models", "pipeline")
BOTTOM = ("motionloom.datasets.motion", "motionloom.datasets.schema", "motionloom.datasets.conditions")
BOTTOM_LIBRARIES = {"numpy", "torch", "roma", "scipy", "pydantic", "motionloom"}


def imports(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write motionloom.…"
            base = node.module or ""
            names.update(f"{base}.{alias.name}" for alias in node.names)
    return names


def files(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def is_bottom(name: str) -> bool:
    return name.startswith(BOTTOM)


@pytest.mark.parametrize("path", files("models"), ids=str)
def test_models_import_only_the_bottom_layer(path: Path) -> None:
    for name in imports(path):
        if name.startswith("motionloom."):
            assert name.startswith("motionloom.models") or is_bottom(name), f"{path} imports {name}"


@pytest.mark.parametrize("path", files("datasets"), ids=str)
def test_datasets_import_neither_models_nor_pipeline(path: Path) -> None:
    for name in imports(path):
        assert not name.startswith(("motionloom.models", "motionloom.pipeline")), f"{path} imports {name}"


@pytest.mark.parametrize("path", [*files("datasets/motion"), ROOT / "datasets/schema.py"], ids=str)
def test_bottom_layer_is_small(path: Path) -> None:
    import sys

    for name in imports(path):
        top = name.split(".")[0]
        assert top in BOTTOM_LIBRARIES or top in sys.stdlib_module_names, f"{path} imports {name}"
        assert not name.startswith("motionloom.") or is_bottom(name), f"{path} imports {name}"


@pytest.mark.parametrize("folder", FOLDERS)
def test_first_party_imports_name_the_package(folder: str) -> None:
    """`import datasets` would find Hugging Face's package or ours, depending on the working directory."""
    for path in files(folder):
        for name in imports(path):
            assert name.split(".")[0] not in FOLDERS, f"{path} imports {name}; write motionloom.{name}"


def test_every_package_is_listed() -> None:
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = {
        "motionloom." + path.parent.relative_to(ROOT).as_posix().replace("/", ".")
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("__init__.py")
    }
    assert listed == found


def test_files_stay_short() -> None:
    for folder in (*FOLDERS, "tests", "benchmarks"):
        for path in files(folder):
            lines = len(path.read_text(encoding="utf-8").splitlines())
            assert lines <= 400, f"{path} has {lines} lines; split it"
