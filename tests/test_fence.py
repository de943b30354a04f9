"""Each folder behind the fence may be removed: the core imports, plans and generates without it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from house_script import FENCE
from own_package import python

ROOT = Path(__file__).resolve().parents[1]

USE = """
import pkgutil, sys
from pathlib import Path
import motionloom
behind = tuple("motionloom." + folder.replace("/", ".") for folder in sys.argv[1:])
for module in pkgutil.walk_packages(motionloom.__path__, "motionloom.", onerror=lambda name: sys.exit(name)):
    if not module.name.startswith(behind) and not module.name.endswith("__main__"):
        __import__(module.name)
for recipe in ("humantomato-tiny", "ude-tiny"):
    motionloom.run_recipe(recipe, dry_run=True)
motions = motionloom.MotionModel.from_pretrained("synthetic").generate(["a person waves"], seconds=1.0)
motionloom.write_motions(Path("out"), motions, ["npz", "bvh", "html"], title="A wave")
print(motionloom.__file__)
"""


@pytest.fixture
def without(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A folder for Python's path with a copy of the package that lacks a folder; large files are links."""
    package = tmp_path / "motionloom"
    package.mkdir()
    for path in ("__init__.py", "__init__.pyi", "__main__.py"):
        shutil.copy2(ROOT / path, package)
    for name in ("configs", "datasets", "models", "pipeline"):
        shutil.copytree(ROOT / name, package / name, ignore=shutil.ignore_patterns("pretrained"))
    (package / "models/pretrained").symlink_to(ROOT / "models/pretrained")
    shutil.rmtree(package / request.param)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("without", FENCE, indirect=True, ids=str)
def test_the_core_works_without_a_folder_behind_the_fence(
    without: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(without)
    said = python(without, USE, *FENCE).splitlines()
    assert Path(said[-1]).samefile(without / "motionloom/__init__.py")
    assert sum("stages would run" in line for line in said) == 2
    assert {path.suffix for path in Path("out").glob("[!.]*")} == {".npz", ".bvh", ".html"}
