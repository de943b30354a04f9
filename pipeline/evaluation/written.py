"""The figures that evaluations have written, read again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

_FILES = ("metrics.json", "dances.json")


def figures_in(folder: Path) -> dict[str, Any]:
    """Figures by the file that holds them, relative to `folder` and without its ending."""
    found = sorted(path for path in folder.rglob("*.json") if path.name in _FILES)
    return {
        path.relative_to(folder).with_suffix("").as_posix(): json.loads(path.read_text(encoding="utf-8"))
        for path in found
    }
