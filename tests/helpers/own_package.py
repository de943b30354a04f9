"""The example package of the documents, installed in a folder of its own, and the program that finds it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np

from motionloom.datasets.motion.skeleton import Skeleton

EXAMPLE = Path(__file__).resolve().parents[2] / "docs/example"


def installed(folder: Path) -> Path:
    """Copy the package and write the metadata that pip would, as a folder for Python's path."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    shutil.copytree(EXAMPLE / "sway", folder / "sway", ignore=shutil.ignore_patterns("__pycache__"))
    about = folder / f"sway-{project['version']}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    ((group, points),) = project["entry-points"].items()
    lines = [f"[{group}]", *(f"{name} = {value}" for name, value in points.items())]
    (about / "entry_points.txt").write_text("\n".join(lines))
    return folder


def takes(folder: Path) -> Path:
    """Write a source for the package's converter: figures that sway."""
    folder.mkdir()
    rest = Skeleton.named("smpl22").rest_joints + np.array([0.0, 1.0, 0.0])
    for number in range(20):
        way = 0.05 * (number % 5) * np.sin(np.arange(60) / (3 + number % 3))
        name = folder / f"{'test' if number % 4 == 3 else 'take'}{number:02d}"
        np.save(name.with_suffix(".npy"), rest + way[:, None, None] * [1.0, 0.0, 0.0])
        words = ("not at all", "a little", "somewhat", "widely", "as far as possible")
        name.with_suffix(".txt").write_text(f"a person sways {words[number % 5]}, take {number}")
    return folder


def program(site: Path | None, *arguments: object, code: int = 0, **variables: object) -> str:
    """What `motionloom` says, with the packages of `site` installed."""
    return _run(site, ["-m", "motionloom", *map(str, arguments)], code, variables)


def python(site: Path | None, source: str, *arguments: object) -> str:
    """What a Python program says."""
    return _run(site, ["-c", source, *map(str, arguments)], 0, {})


def _run(site: Path | None, words: list[str], code: int, variables: dict[str, object]) -> str:
    path = os.pathsep.join(filter(None, (str(site or ""), os.environ.get("PYTHONPATH"))))
    given = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "COLUMNS": "140"}
    given |= {name: str(value) for name, value in variables.items()}
    done = subprocess.run(
        [sys.executable, "-P", *words],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=280, env=given,
    )  # fmt: skip
    assert done.returncode == code, done.stdout[-5000:]
    return done.stdout
