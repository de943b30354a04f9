"""Rows of a batch, its conditions included."""

from __future__ import annotations

from typing import Any

from motionloom.datasets.conditions import Condition


def rows_of(batch: dict[str, Any], rows: slice) -> dict[str, Any]:
    """The same batch with those rows alone."""
    return {name: _rows(value, rows) for name, value in batch.items()}


def _rows(value: Any, rows: slice) -> Any:
    if isinstance(value, dict):
        return rows_of(value, rows)
    if isinstance(value, Condition):
        return Condition(*(None if part is None else part[rows] for part in value))
    return value[rows]
