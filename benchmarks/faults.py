"""Injects faults into a copy of the checkout, one at a time, and shows which the tests find.

    python benchmarks/faults.py                    # all, about half an hour on one core
    python benchmarks/faults.py --only codebook    # those whose name holds the word

Each fault replaces one piece of text that stands once in the sources by another, and runs the fast tests of
the folders that should notice. A fault is found when a test fails. The copy is deleted afterwards.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import yaml

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ("datasets", "models", "pipeline")


class Fault(NamedTuple):
    """One injected mistake."""

    name: str
    old: str
    new: str
    tests: str
    """Files and folders of `tests/`, separated by blanks; behind `slow:` their slow tests run too."""


FAULTS = [Fault(**row) for row in yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text("utf-8"))]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--only", default="", help="a word in the names of faults")
    options = parser.parse_args()
    found = missed = 0
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "motionloom"
        leave = shutil.ignore_patterns("__pycache__")
        for name in (*SOURCE, "configs", "tests", "docs", "benchmarks"):
            shutil.copytree(ROOT / name, place / "tree" / name, ignore=leave)
        for page in (*ROOT.glob("*.md"), ROOT / "pyproject.toml"):
            shutil.copy(page, place / "tree")
        (place / "path" / "motionloom").mkdir(parents=True)
        for name in (*SOURCE, "configs"):
            (place / "path" / "motionloom" / name).symlink_to(place / "tree" / name)
        for fault in FAULTS:
            if options.only not in fault.name:
                continue
            began = time.monotonic()
            result = inject(fault, place)
            found = found + (result == "found")
            missed = missed + (result != "found")
            print(f"{result:9} {time.monotonic() - began:5.0f} s  {fault.name}", flush=True)
    print(f"{found} found, {missed} not")
    sys.exit(missed > 0)


def inject(fault: Fault, place: Path) -> str:
    """`found`, `MISSED`, or why it could not be tried."""
    tree = place / "tree"
    homes = [
        path
        for name in SOURCE
        for path in (tree / name).rglob("*.py")
        if fault.old in path.read_text("utf-8")
    ]
    if len(homes) != 1 or homes[0].read_text("utf-8").count(fault.old) != 1:
        return f"in {len(homes)} files"
    text = homes[0].read_text("utf-8")
    tests = [
        str(tree / "tests" / name)
        for name in fault.tests.removeprefix("slow:").split()
        if (tree / "tests" / name).exists()
    ]
    homes[0].write_text(text.replace(fault.old, fault.new), "utf-8")
    try:
        marks = "not browser and not slurm" + ("" if fault.tests.startswith("slow:") else " and not slow")
        pytest = [sys.executable, "-P", "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-m", marks]
        given = {"PYTHONPATH": str(place / "path"), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
        run = subprocess.run(
            [*pytest, *tests], cwd=tree, env={**os.environ, **given}, capture_output=True, text=True
        )
    finally:
        homes[0].write_text(text, "utf-8")
    return {0: "MISSED", 1: "found"}.get(run.returncode, f"exit {run.returncode}")


if __name__ == "__main__":
    main()
