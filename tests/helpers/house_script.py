"""`benchmarks/house.py`, which is in no package: the fence, and figures of the source."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType


def _loaded() -> ModuleType:
    path = Path(__file__).resolve().parents[2] / "benchmarks" / "house.py"
    spec = importlib.util.spec_from_file_location("house", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


house = _loaded()
FENCE: tuple[str, ...] = house.FENCE
"""Folders of what neither paper needs: nothing imports them, and each may be removed."""
