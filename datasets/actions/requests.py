"""Requests of captions, by whoever is registered to read captions; none where nobody is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from motionloom.datasets.actions.dances import Record
from motionloom.datasets.base.register import Table, discover


@dataclass(frozen=True)
class CaptionRequest:
    """Truth records with what a caption asks for, the likelier first; none where it names no action.

    `refused` is set where it takes an action back, or asks for more than two.
    """

    candidates: tuple[Record, ...] = ()
    refused: bool = False
    without: tuple[str, ...] = ()
    """Actions that it takes back."""


@dataclass(frozen=True)
class CaptionReader:
    """Reads captions of one language; `register` adds one."""

    name: str
    read: Callable[[str], CaptionRequest]
    words: Callable[[str], tuple[str, ...]]
    """Every action that a caption has a word of, of the fingers too."""


READERS: Table[CaptionReader] = Table(CaptionReader, "reader of captions")


def read_caption(caption: str) -> CaptionRequest:
    """Return what the first reader finds that finds anything."""
    discover()
    found = (reader.read(caption) for reader in READERS.values())
    return next((one for one in found if one.candidates or one.refused), CaptionRequest())


def words_of_actions(caption: str) -> set[str]:
    """Return the actions that a caption has a word of, asked for or not."""
    discover()
    return {action for reader in READERS.values() for action in reader.words(caption)}
