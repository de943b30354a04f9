"""Every script of `benchmarks/` can be loaded and says what it measures: none imports what has moved away."""

from __future__ import annotations

import argparse
import importlib.util
import re
import shlex
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
SCRIPTS = sorted(FOLDER.glob("*.py"))


DOCS = sorted([*FOLDER.parent.glob("*.md"), *FOLDER.parent.glob("docs/*.md")])
COMMANDS = sorted(
    {
        found.strip("` ").removeprefix("python benchmarks/")
        for page in DOCS
        for found in re.findall(
            r"^python benchmarks/.*|`python benchmarks/\S* [^`\n]*`", page.read_text(), re.MULTILINE
        )
    }
)
"""Every command of a benchmark that the documents give, without `python benchmarks/`.

In a sentence a script's name alone is none.
"""


def loaded(script: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(FOLDER))  # some share functions
    spec = importlib.util.spec_from_file_location(f"benchmark_{script.stem}", script)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_benchmark_can_be_loaded(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = loaded(script, monkeypatch)
    assert callable(module.main) and module.__doc__
    assert f"benchmarks/{script.name}" in module.__doc__, "its command stands in its docstring"


class ReadError(Exception):
    """The arguments have been read."""


@pytest.mark.parametrize("command", COMMANDS)
def test_the_documents_commands_have_options_that_exist(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Arguments are read and nothing is measured; whole words, since argparse takes beginnings for them."""
    name, *words = shlex.split(command)
    init, parse = argparse.ArgumentParser.__init__, argparse.ArgumentParser.parse_args

    def exact(self: argparse.ArgumentParser, *given: Any, **options: Any) -> None:
        init(self, *given, **{**options, "allow_abbrev": False})

    def read(self: argparse.ArgumentParser, *given: Any, **options: Any) -> None:
        parse(self, *given, **options)
        raise ReadError

    module = loaded(FOLDER / name, monkeypatch)
    monkeypatch.setattr(argparse.ArgumentParser, "__init__", exact)
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", read)
    monkeypatch.setattr(sys, "argv", [name, *words])
    try:
        module.main()
    except ReadError:
        return
    except SystemExit:
        pytest.fail(capsys.readouterr().err)
