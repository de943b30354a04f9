"""Clips left out of a data set: by reason, counted, and listed in a file beside the shards.

Reasons that differ in names and numbers alone (`0.67 s, shorter than 1 s`) form one group, shown as one line.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_text
from motionloom.datasets.base.os_errors import of_the_machine
from motionloom.datasets.base.printable import printable
from motionloom.datasets.base.records import Dropped

LEFT_OUT_FILE = "left-out.txt"
"""Beside the manifest, when there is anything to list: kind, source and reason of each, between tabs."""

DOUBTFUL = "doubtful motion: "
"""Begins the notes on what the judge of motion has found."""

_QUOTED = re.compile(r"'[^']*'")
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:[.,]\d+)*(?:e[+-]?\d+)?")
_FILE = re.compile(r"(?<!m)(?!m/s\b)[^\s'\",;()]*(?:/|\.[A-Za-z]\w{1,4}\b)[^\s'\",;:()]*")


def drop(label: str, error: Exception) -> Dropped:
    """The manifest's record of a clip or file that failed; raises an error that is the machine's fault."""
    if of_the_machine(error):
        raise error
    text = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
    if isinstance(error, OSError) and error.strerror:  # whose own words name a path of this machine
        text = f"cannot be read ({error.strerror.lower()})"
    return Dropped(source=label, reason=text.removeprefix(str(UserError(f"{label}: "))))


@dataclass(frozen=True)
class Group:
    """Messages that differ in names and numbers alone."""

    kind: str
    """The reason with `…` for what differs."""
    members: tuple[Dropped, ...]

    @property
    def count(self) -> int:
        return len(self.members)

    def __str__(self) -> str:
        first = self.members[0]
        if self.count == 1:
            return f"{first.source}: {first.reason}"
        return f"{self.count} x {self.kind} (the first: {first.source})"


def kind_of_reason(reason: str, source: str = "") -> str:
    """Return a reason with `…` for names, quoted words, files and numbers, which differ from clip to clip."""
    text = reason.replace(source, "…") if source else reason
    text = _FILE.sub("…", _QUOTED.sub("'…'", text))
    return _NUMBER.sub("…", text)[:200]


def grouped(dropped: Iterable[Dropped]) -> list[Group]:
    """The groups, the largest first."""
    groups: dict[str, list[Dropped]] = defaultdict(list)
    for drop in dropped:
        groups[kind_of_reason(drop.reason, drop.source)].append(drop)
    ranked = sorted(groups.items(), key=lambda item: (-len(item[1]), item[0]))
    return [Group(kind, tuple(members)) for kind, members in ranked]


def grouped_notes(notes: Sequence[str]) -> list[str]:
    """Return notes in order; four or more of one kind become one line with their number and the first."""
    kinds: dict[str, list[str]] = defaultdict(list)
    for note in notes:
        kinds[kind_of_reason(note)].append(note)
    out: list[str] = []
    for same in kinds.values():
        out += same if len(same) < 4 else [f"{same[0]} (and {len(same) - 1} more like it)"]
    return out


def doubtful(doubts: Iterable[Dropped]) -> list[str]:
    """Notes on what the judge of motion has found in clips, a line for each kind."""
    ordered = sorted(doubts, key=lambda one: one.source)
    return [f"{DOUBTFUL}{group}" for group in grouped(ordered)]


def tally(dropped: Iterable[Dropped]) -> str:
    """`3 rejected, 1 unreadable file, 2 missing`, each thing counted once; empty when there is nothing."""
    sources = {(drop.kind, drop.source) for drop in dropped}
    counts: Counter[str] = Counter(kind for kind, _ in sources)
    words = {"rejected": "rejected", "unreadable": "unreadable file", "missing": "missing"}
    return ", ".join(
        f"{counts[kind]:,} {word}{'s' if kind == 'unreadable' and counts[kind] > 1 else ''}"
        for kind, word in words.items()
        if counts[kind]
    )


def write_left_out(out: Path, dropped: Sequence[Dropped]) -> None:
    """List everything that was left out in `LEFT_OUT_FILE`, in the manifest's order; no file for nothing."""
    path = out / LEFT_OUT_FILE
    lines = [f"{drop.kind}\t{printable(drop.source)}\t{printable(drop.reason)}\n" for drop in dropped]
    if lines:
        write_text(path, "".join(lines))
    elif path.is_file():
        path.unlink()
