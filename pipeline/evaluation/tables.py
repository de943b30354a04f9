"""Figures as plain JSON and as tables for people."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from motionloom.pipeline.evaluation.figures import Interval


def plain(value: Any) -> Any:
    """Figures as JSON types, rounded to five decimals."""
    if isinstance(value, Interval):
        return {k: round(v, 5) for k, v in asdict(value).items()}
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    return round(float(value), 5) if isinstance(value, float | np.floating) else value


def interval(value: Mapping[str, float]) -> str:
    """A mean with its interval, of `plain`; without one where nothing was repeated."""
    mean, half = _number(value["mean"]), value["half_width"]
    return f"{mean} ± {_number(half)}" if half else mean


def _number(value: float) -> str:
    """Three decimals, of large numbers four digits."""
    return f"{value:.4g}" if abs(value) >= 100 else f"{value:.3f}"


def print_tables(console: Console, tables: Iterable[tuple[str, list[str], list[list[str]]]]) -> None:
    """(title, columns, rows) of each table."""
    for title, columns, rows in tables:
        table = Table(*map(escape, columns), title=escape(title), title_justify="left")
        for row in rows:
            table.add_row(*map(escape, row))
        console.print(table)
