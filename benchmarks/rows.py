"""Rows of a benchmark in a file, for a machine that is lent for minutes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

FIRST = {"compiled": 60.0}
"""Seconds that the first row of a table may take, where that is long."""
Cells = dict[str, str]


class Rows:
    """Rows in a file, each written as it is measured, while there is time."""

    def __init__(self, path: Path, minutes: float, only: list[str]) -> None:
        self.path = path
        self.end = time.monotonic() + 60 * minutes
        self.only = tuple(only)
        lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
        self.rows: list[dict[str, Any]] = [json.loads(line) for line in lines]
        self.left_out: list[str] = []

    def measure(self, table: str, title: str, cells: Callable[[], Cells]) -> None:
        """Add a row unless it is there, not asked for, or not done in time; an error is a row too."""
        if self.only and not f"{table} {title}".startswith(self.only):
            return
        of_table = [row for row in self.rows if row["table"] == table]
        if any(row["title"] == title for row in of_table):
            return
        begin = time.monotonic()
        if begin + (of_table[-1]["seconds"] if of_table else FIRST.get(table, 0.0)) > self.end:
            self.left_out.append(f"{table}: {title}")
            return
        try:
            found = cells()
        except Exception as error:  # the next rows may work
            found = {"error": f"{type(error).__name__}: {str(error)[:300]}"}
        row = {"table": table, "title": title, "cells": found, "seconds": time.monotonic() - begin}
        self.rows.append(row)
        line = json.dumps(row)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")
        print(line, flush=True)  # a pipe keeps back what is not flushed, and a kill loses that
