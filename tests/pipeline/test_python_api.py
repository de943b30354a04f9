"""`motionloom.pipeline` as a library: every name there is, documented, and cheap to import."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import motionloom.pipeline as api

PAGES = sorted((Path(__file__).resolve().parents[2] / "docs").glob("*.md"))


@pytest.mark.parametrize("name", api.__all__)
def test_every_name_is_there_and_documented(name: str) -> None:
    found = getattr(api, name)
    assert found.__name__ == name and found.__doc__
    assert any(name in page.read_text(encoding="utf-8") for page in PAGES)


def test_no_name_is_defined_twice_or_forgotten() -> None:
    listed = [name for names in api._NAMES.values() for name in names.split()]
    assert sorted(listed) == api.__all__
    assert set(api.__all__) <= set(dir(api))
    with pytest.raises(AttributeError, match="has no attribute 'Motion'"):
        api.Motion  # noqa: B018


def test_importing_it_brings_in_no_heavy_library() -> None:
    code = "import sys, motionloom.pipeline; print(sorted({'torch', 'numpy', 'pydantic'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_help_is_printed_without_torch() -> None:
    code = (
        "import sys\nfrom motionloom.pipeline.cli.main import app\n"
        "app(['run', '--help'], standalone_mode=False)\nprint('torch' in sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert "Run a recipe" in done.stdout and done.stderr.strip() == "False"
