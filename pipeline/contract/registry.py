"""The table of stage kinds. Ours and those of other packages come in the same way.

A package adds kinds by an entry point of the group `motionloom.stages` that names a module; a lone file by
the environment variable `MOTIONLOOM_STAGES`, a comma-separated list of importable modules. The module calls
`register(MyStage())`. A recipe never names code: it is data, and reading one runs nothing.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import TypeVar

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.stage import StageKind

VARIABLE = "MOTIONLOOM_STAGES"
_GROUP = "motionloom.stages"
_KINDS: dict[str, StageKind] = {}
_loaded = False

K = TypeVar("K", bound=StageKind)


def register(kind: K) -> K:
    """Add a kind to the table; its name must be new."""
    if _KINDS.setdefault(kind.name, kind) is not kind:
        raise UserError(f"two stage kinds are called '{kind.name}'; rename one of them")
    return kind


def stage_kinds() -> Mapping[str, StageKind]:
    """All kinds by name, those of other packages included."""
    global _loaded
    if not _loaded:
        _loaded = True
        for point in entry_points(group=_GROUP):
            point.load()
        for module in filter(None, map(str.strip, os.environ.get(VARIABLE, "").split(","))):
            try:
                importlib.import_module(module)
            except ImportError as error:
                raise UserError(
                    f"{VARIABLE}={module}: cannot be imported ({error}); name a module on Python's path"
                ) from None
    return _KINDS


def stage_kind(name: str, where: str) -> StageKind:
    """A kind by name; `where` is what names it, for the message."""
    kinds = stage_kinds()
    if name not in kinds:
        raise UserError(
            f"{where}: stage kind '{name}' is not known here; name the module that registers it in {VARIABLE}"
        )
    return kinds[name]
