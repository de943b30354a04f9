"""What `motionloom`, `.models`, `.datasets` and `.pipeline` offer: there, documented, and cheap to import."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

FACADES = ("motionloom", "motionloom.models", "motionloom.datasets", "motionloom.pipeline")
NAMES = [(facade, name) for facade in FACADES for name in import_module(facade).__all__]
PAGES = sorted((Path(__file__).resolve().parents[1] / "docs").glob("*.md"))


@pytest.mark.parametrize(("facade", "name"), NAMES)
def test_every_name_is_documented(facade: str, name: str) -> None:
    """With shapes where it takes or returns arrays; what a program begins with also on a page."""
    found = getattr(import_module(facade), name)
    assert found.__name__ == name and found.__doc__ and name in dir(import_module(facade))
    if facade == "motionloom":
        assert any(name in page.read_text(encoding="utf-8") for page in PAGES)
    computing = [vars(found).get(key) for key in ("forward", "losses")] if inspect.isclass(found) else [found]
    for member in filter(inspect.isfunction, computing):
        assert member.__doc__, f"{name}.{member.__name__}"
        arrays = re.search(r"Tensor|NDArray|Batch", " ".join(map(str, member.__annotations__.values())))
        assert not arrays or "[" in member.__doc__, f"{name}.{member.__name__} says no shapes"


def test_an_unknown_name_is_refused() -> None:
    for facade in FACADES:
        with pytest.raises(AttributeError, match="Motoin"):
            getattr(import_module(facade), "Motoin")  # noqa: B009


def loaded(code: str) -> set[str]:
    """Libraries that a program has imported at its end."""
    heavy = {"torch", "numpy", "pydantic", "lightning", "transformers", "librosa"}
    code += f"\nimport sys; print(*sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


def test_importing_brings_in_no_more_than_is_used() -> None:
    assert loaded("import motionloom.models, motionloom.datasets, motionloom.pipeline") == set()
    lightning = r"Module$|OptimizerGroup|AveragedWeights"
    torch = [name for facade, name in NAMES if facade == FACADES[1] and not re.search(lightning, name)]
    assert len(torch) > 25
    assert "lightning" not in loaded(f"from motionloom.models import {', '.join(torch)}")
    help_page = "from motionloom.pipeline.cli.main import app\napp(['run', '--help'], standalone_mode=False)"
    assert "torch" not in loaded(help_page)


def test_the_version_is_that_of_the_package() -> None:
    code = "from motionloom import MotionModel, __version__; print(MotionModel.__name__, __version__)"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert re.fullmatch(r"MotionModel \d+\.\d+\.\d+\S*", done.stdout.strip())
