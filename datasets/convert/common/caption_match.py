"""Which clip of a source a row of captions means, and what is nearest where it means none."""

from __future__ import annotations

import bisect
import difflib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from motionloom.datasets.convert.common.caption_row import CaptionRow, bare

_ALL = 400
"""Up to so many names are all compared; of more, those that stand around a name in the alphabet."""
_LIKE = 0.6
"""Least likeness (`difflib`'s ratio) of a name that is shown, the default of `get_close_matches`."""


@dataclass(frozen=True)
class CaptionMatch:
    """Rows by the paths of motion files."""

    rows: dict[str, CaptionRow] = field(default_factory=dict)
    unused: list[CaptionRow] = field(default_factory=list)
    """Rows that name no motion file of the source."""
    free: tuple[str, ...] = ()
    """Files without a row."""

    def nearest(self, row: CaptionRow, number: int = 2) -> list[str]:
        """Files without a row whose names are most like the row's."""
        return nearest(row.names()[0], self.free, number)


def match(rows: Mapping[str, CaptionRow], paths: Iterable[str]) -> CaptionMatch:
    """Find the row of every motion file.

    Suffixes do not matter. A file's row is the one that names its path; else one that names the end of it
    (`walk` means `walks/walk.bvh`), or whose own end it is (`mocap/walks/walk`); else the only one with the
    same last name, where no other file has it.
    """
    files = {path: bare(path) for path in paths}
    by_name: dict[str, CaptionRow] = {}
    for row in rows.values():
        for name in reversed(row.names()):
            by_name.setdefault(name, row)
    by_end = _by_end(by_name)
    found: dict[str, CaptionRow] = {}
    for path, name in files.items():
        made = next((by_name[end] for end in _ends(name) if end in by_name), by_end.get(name))
        if made is not None:
            found[path] = made
    used = {row.id for row in found.values()}
    last = {path: name.rsplit("/", 1)[-1] for path, name in files.items() if path not in found}
    left = [row for row in rows.values() if row.id not in used]
    stems = Counter(stem for row in left for stem in _stems(row))
    by_stem = {stem: row for row in left for stem in _stems(row) if stems[stem] == 1}
    counts = Counter(last.values())
    for path, stem in last.items():
        if counts[stem] == 1 and stem in by_stem:
            found[path] = by_stem[stem]
    used = {row.id for row in found.values()}
    return CaptionMatch(
        found,
        [row for row in rows.values() if row.id not in used],
        tuple(path for path in files if path not in found),
    )


def _ends(name: str) -> list[str]:
    """`a/b/c`, `b/c`, `c`."""
    pieces = name.split("/")
    return ["/".join(pieces[first:]) for first in range(len(pieces))]


def _stems(row: CaptionRow) -> set[str]:
    return {name.rsplit("/", 1)[-1] for name in row.names()}


def _by_end(by_name: Mapping[str, CaptionRow]) -> dict[str, CaptionRow]:
    """Rows by the ends of their names that only one row has."""
    ends: dict[str, CaptionRow | None] = {}
    for name, row in by_name.items():
        for end in _ends(name)[1:]:
            ends[end] = row if ends.get(end, row) is row else None
    return {end: row for end, row in ends.items() if row is not None}


def nearest(name: str, candidates: Sequence[str], number: int = 2) -> list[str]:
    """The candidates most like a name by their last names, best first; none that is like it in nothing.

    Of very many candidates only those with a like beginning or a like end are compared.
    """
    wanted = _stem(name)
    stems = [(_stem(candidate), candidate) for candidate in candidates]
    if len(stems) > _ALL:
        stems = sorted({*_around(wanted, stems, 1), *_around(wanted, stems, -1)})
    scored = []
    for stem, candidate in stems:
        ratio = difflib.SequenceMatcher(None, wanted, stem).ratio()
        if ratio >= _LIKE:
            scored.append((-ratio, candidate))
    return [candidate for _, candidate in sorted(scored)[:number]]


def _stem(name: str) -> str:
    return bare(name).rsplit("/", 1)[-1].lower()


def _around(wanted: str, stems: list[tuple[str, str]], step: int) -> list[tuple[str, str]]:
    """The names next to one in the alphabet; with step -1 in that of names read backwards."""
    ordered = sorted(stems, key=lambda pair: pair[0][::step])
    place = bisect.bisect_left(ordered, wanted[::step], key=lambda pair: pair[0][::step])
    return ordered[max(0, place - _ALL // 4) : place + _ALL // 4]
