"""The tables that come with the package, by name: `configs/tables/PAPER/NUMBER.yaml` is `PAPER/NUMBER`."""

from __future__ import annotations

import difflib
from importlib import resources
from pathlib import Path

from motionloom.datasets.schema import UserError
from motionloom.pipeline.published.schema import PaperTable
from motionloom.pipeline.store.yaml import read_yaml


def shipped_tables() -> dict[str, Path]:
    """Files by name, in the papers' order."""
    folder = Path(str(resources.files("motionloom.configs"))) / "tables"
    paths = sorted(folder.glob("*/*.yaml"), key=lambda path: (path.parent.name, int(path.stem)))
    return {f"{path.parent.name}/{path.stem}": path for path in paths}


def paper_table(name: str) -> PaperTable:
    """A table by its name, such as `humantomato/7`, or from a file of one's own, such as `mine.yaml`."""
    if name.endswith((".yaml", ".yml")):
        return PaperTable.parse(read_yaml(Path(name)), name)
    shipped = shipped_tables()
    if name not in shipped:
        near = difflib.get_close_matches(name.lower(), shipped, n=1, cutoff=0.5)
        hint = f"did you mean '{near[0]}'?" if near else "motionloom evaluate --tables lists them"
        raise UserError(f"--table {name}: no such table; {hint}")
    path = shipped[name]
    return PaperTable.parse(read_yaml(path), str(path))
