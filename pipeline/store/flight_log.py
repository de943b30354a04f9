"""`flight/rank_N.jsonl` of a training: what each process notes of its steps; no output, it holds times.

A row every ten steps, plain JSON. The file stays below a number of rows: where it would have more, every
second one of the older half goes, so the latest steps are always there in full and the beginning in outline.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from motionloom.datasets.base.files import write_text

FOLDER = "flight"
"""Of a stage's folder."""


class FlightLog:
    """The log of one process; `most` rows at any time."""

    def __init__(self, path: Path, most: int) -> None:
        self.path, self.most = path, most
        self._lines: list[str] = []

    def begin(self, step: int) -> None:
        """Go on behind step `step`: rows of later steps, which come again, are dropped."""
        kept = [row for row in read_rows(self.path) if row["step"] <= step]
        self._lines = [_line(row) for row in kept]
        self._rewrite()

    def take(self, row: dict[str, Any]) -> None:
        """Append one row; it needs "step"."""
        self._lines.append(_line(row))
        if len(self._lines) > self.most:
            half = len(self._lines) // 2
            self._lines = self._lines[:half:2] + self._lines[half:]
            self._rewrite()
            return
        with self.path.open("a", encoding="utf-8") as file:
            file.write(self._lines[-1])

    def _rewrite(self) -> None:
        write_text(self.path, "".join(self._lines))


def _line(row: dict[str, Any]) -> str:
    return json.dumps(row) + "\n"


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of a flight log; none where there is no file. A line that a kill has cut short is left out."""
    if not path.is_file():
        return []
    rows = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict) and isinstance(row.get("step"), int):
            rows.append(row)
    return rows


def read_flight(folder: Path) -> dict[int, list[dict[str, Any]]]:
    """The flight logs in a stage's folder, by rank."""
    found = {}
    for path in sorted((folder / FOLDER).glob("rank_*.jsonl")):
        rank = path.stem.removeprefix("rank_")
        if rank.isdecimal() and (rows := read_rows(path)):
            found[int(rank)] = rows
    return found
