"""The table of modalities. Each of ours stands as `RECORD` in the file of its name here."""

from __future__ import annotations

from importlib import import_module

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.register import Table, register
from motionloom.datasets.modalities.modality import Modality

NAMES = ("text", "audio")
"""In the order in which networks read them."""

MODALITIES: Table[Modality] = Table(Modality, "modality")
for _name in NAMES:
    register(import_module(f"motionloom.datasets.modalities.{_name}").RECORD)


def modality(name: str) -> Modality:
    """The record of a name; `UserError` names those there are."""
    if name not in MODALITIES:
        raise UserError(f"no modality '{name}'; known: {', '.join(MODALITIES)}")
    return MODALITIES[name]
