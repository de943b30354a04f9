"""The table of modalities: a name for each record, which stands as `RECORD` in the file of that name here."""

from __future__ import annotations

from importlib import import_module

from motionloom.datasets.modalities.modality import Modality
from motionloom.datasets.schema import UserError

NAMES = ("text", "audio")
"""In the order in which networks read them."""

MODALITIES: dict[str, Modality] = {
    name: import_module(f"motionloom.datasets.modalities.{name}").RECORD for name in NAMES
}


def modality(name: str) -> Modality:
    """The record of a name; `UserError` names those there are."""
    if name not in MODALITIES:
        raise UserError(f"no modality '{name}'; known: {', '.join(MODALITIES)}")
    return MODALITIES[name]
