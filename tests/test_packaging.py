"""What pyproject.toml requires is what the packages import, and what it builds is all of them."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from configparser import ConfigParser
from email import message_from_bytes
from importlib.metadata import packages_distributions, requires
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("configs", "datasets", "models", "pipeline")
CONFIG = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = CONFIG["project"]

# Imported by Lightning's loggers and by fsspec, which are what we import.
THROUGH_LIBRARIES = {"tensorboard", "wandb", "mlflow", "gcsfs", "adlfs"}

BROUGHT = {
    "tokenizers": "transformers",
    "soxr": "librosa",
    "lazy-loader": "librosa",
    "pydantic-core": "pydantic",
    "h11": "uvicorn",
}
"""Imported by us too, and required by a package that we require."""


def canonical(name: str) -> str:
    """A distribution's name as the package index compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def declared(requirements: list[str]) -> set[str]:
    return {canonical(re.split(r"[\s\[<>=!~;]", requirement)[0]) for requirement in requirements}


REQUIRED = declared(PROJECT["dependencies"])
OPTIONAL = {name for extra in PROJECT["optional-dependencies"].values() for name in declared(extra)}


def imports(tree: ast.Module) -> set[tuple[str, bool]]:
    """Top-level names that a file imports, at once (False) or inside a function (True).

    `find_spec("x")` looks for a package's files without importing it.
    """
    functions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
    inner = {id(n) for one in ast.walk(tree) if isinstance(one, functions) for n in ast.walk(one)}
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {(alias.name.split(".")[0], id(node) in inner) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(((node.module or "").split(".")[0], id(node) in inner))
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = getattr(node.func, "id", getattr(node.func, "attr", ""))
            asked = {"find_spec", "import_module"} & {called}
            found |= {(str(node.args[0].value).split(".")[0], True) for _ in asked}
    return found


BEHIND_AN_EXTRA = ("pipeline/serve",)
"""Rooms that a function imports, which says in a sentence which extra is missing: all in them is optional."""
OF_THE_SERVER = [ROOT / f"pipeline/{room}/served.py" for room in ("editing", "rigs")]
"""Parts that only the server imports, from a table."""


def uses() -> dict[tuple[str, bool], set[str]]:
    """(distribution, inside a function) -> files."""
    owners = packages_distributions()
    found: dict[tuple[str, bool], set[str]] = {}
    for path in sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        behind = path.parent.relative_to(ROOT).as_posix() in BEHIND_AN_EXTRA or path in OF_THE_SERVER
        for name, own in imports(ast.parse(path.read_text(encoding="utf-8"))):
            inside = own or behind
            if name == "motionloom" or name in sys.stdlib_module_names:
                continue
            for owner in owners.get(name, [name]):
                found.setdefault((canonical(owner), inside), set()).add(path.relative_to(ROOT).as_posix())
    return found


def test_every_import_is_declared() -> None:
    for (owner, inside), files in uses().items():
        allowed = (REQUIRED | OPTIONAL if inside else REQUIRED) | BROUGHT.keys()
        where = "in a function" if inside else "at the top of the file"
        assert owner in allowed, f"{owner} is imported {where} by {sorted(files)}, but not declared for that"


@pytest.mark.parametrize("room", BEHIND_AN_EXTRA)
def test_rooms_behind_an_extra_are_imported_in_functions(room: str) -> None:
    module = f"motionloom.{room.replace('/', '.')}"
    for path in (path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        if path.parent == ROOT / room or path in OF_THE_SERVER:
            continue
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            names = [getattr(node, "module", None) or "", *(a.name for a in getattr(node, "names", ()))]
            assert not any(name.startswith(module) for name in names), f"{path} imports {room} at its top"


def test_everything_declared_is_imported() -> None:
    imported = {owner for owner, _ in uses()}
    assert imported >= REQUIRED - THROUGH_LIBRARIES, (
        f"never imported: {REQUIRED - THROUGH_LIBRARIES - imported}"
    )
    assert imported >= OPTIONAL - THROUGH_LIBRARIES, f"never imported: {OPTIONAL - imported}"


def test_what_others_bring_they_require() -> None:
    for name, other in BROUGHT.items():
        needed = [one for one in requires(other) or () if "extra ==" not in one]
        assert other in REQUIRED | OPTIONAL | BROUGHT.keys() and name in declared(needed)


def test_nothing_is_both_required_and_optional() -> None:
    assert not REQUIRED & OPTIONAL


BESIDE = (".ci", "benchmarks", "docs", "tests")
"""Folders of the source distribution that are no part of the package."""
TOP = ("__init__.py", "__init__.pyi", "py.typed")
"""Files of the package itself, beside its folders."""
ALONE = (
    *TOP, ".gitignore", ".pre-commit-config.yaml", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE",
    "MANIFEST.in", "Makefile", "README.md", "constraints.txt", "pyproject.toml", "setup.py",
)  # fmt: skip


def files_of(*folders: str) -> set[str]:
    """Files of the tree's folders, without what running the code leaves there."""
    paths = (path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file())
    return {p.relative_to(ROOT).as_posix() for p in paths if "__pycache__" not in p.parts}


def hook(name: str, tree: Path, out: Path) -> Path:
    """What the build backend's `build_sdist` or `build_wheel` makes of a tree."""
    code = f"from setuptools import build_meta; build_meta.{name}({str(out)!r})"
    subprocess.run([sys.executable, "-P", "-c", code], cwd=tree, check=True, capture_output=True)
    (made,) = out.iterdir()
    return made


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The source distribution, built from a copy: building writes into the tree."""
    tree = tmp_path_factory.mktemp("tree")
    for name in (*files_of(*FOLDERS, *BESIDE), *ALONE):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, tree / name)
    return hook("build_sdist", tree, tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from the unpacked source distribution and nothing else."""
    folder = tmp_path_factory.mktemp("unpacked")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    (tree,) = folder.iterdir()
    return hook("build_wheel", tree, tmp_path_factory.mktemp("wheel"))


def test_the_sdist_is_the_tree(sdist: Path) -> None:
    with tarfile.open(sdist) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames() if archive.getmember(name).isfile()}
    generated = {name for name in inside if name.startswith("motionloom.egg-info/")}
    assert inside - generated - {"PKG-INFO", "setup.cfg"} == files_of(*FOLDERS, *BESIDE) | set(ALONE)


def test_the_wheel_has_every_file_of_the_packages(wheel: Path) -> None:
    """Recipes, the papers' tables, skeletons, models, READMEs, the pages' css, js and html."""
    with zipfile.ZipFile(wheel) as archive:
        inside = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert inside == {f"motionloom/{name}" for name in (*TOP, *files_of(*FOLDERS))}
    kinds = {".py", ".pyi", ".yaml", ".json", ".csv", ".css", ".js", ".html", ".npz", ".typed", ".md"}
    if any((ROOT / "models" / "pretrained").glob("*/bundle.json")):
        kinds |= {".safetensors"}
    assert {Path(name).suffix or Path(name).name for name in inside} == kinds


def test_the_wheel_says_what_pyproject_says(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (folder,) = {name.split("/")[0] for name in archive.namelist() if ".dist-info/" in name}
        about = message_from_bytes(archive.read(f"{folder}/METADATA"))
        points = archive.read(f"{folder}/entry_points.txt").decode()
        assert archive.read(f"{folder}/licenses/LICENSE") == (ROOT / "LICENSE").read_bytes()
    assert wheel.name == f"motionloom-{PROJECT['version']}-py3-none-any.whl"
    assert about["Requires-Python"] == PROJECT["requires-python"]
    required = [line for line in about.get_all("Requires-Dist", []) if "extra ==" not in line]
    assert declared(required) == REQUIRED
    assert set(about.get_all("Provides-Extra", [])) == set(PROJECT["optional-dependencies"])
    parser = ConfigParser()
    parser.read_string(points)
    groups = {"console_scripts": PROJECT["scripts"], **PROJECT["entry-points"]}
    assert {group: dict(parser[group]) for group in parser.sections()} == groups


@pytest.mark.parametrize(
    ("message", "fine"),
    [
        ("Part: why\n\nBecause.\n# a comment", 1),
        ("x" * 73 + "\n\nBecause.", 0),
        ("a; b\n\nBecause.", 0),
        ("No", 0),
    ],
)
def test_a_commit_has_one_subject_and_a_body(tmp_path: Path, message: str, fine: int) -> None:
    (tmp_path / "message").write_text(message)
    done = subprocess.run(
        [ROOT / ".ci/commit-message", tmp_path / "message"], capture_output=True, check=False
    )
    assert done.returncode == 1 - fine and bool(done.stderr) != bool(fine)
