"""Rows of one model that several evaluations of a run have measured: equal ones once, others by name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from motionloom.pipeline.published.filled import FilledRow


def without_repetitions(rows: Sequence[FilledRow]) -> list[FilledRow]:
    """Rows of one run, without those that say no more of their model than another one does."""
    out: list[FilledRow] = []
    for row in rows:
        if any(_covers(other, row) for other in out):
            continue
        out = [other for other in out if not _covers(row, other)]
        out.append(row)
    return out


def _covers(one: FilledRow, other: FilledRow) -> bool:
    """Whether every figure of `other` stands in `one`, of the same models."""
    same = one.run == other.run and set(other.stages) <= set(one.stages)
    pairs = zip(one.cells, other.cells, strict=True)
    return same and all(b is None or (a is not None and a.text == b.text) for a, b in pairs)


def named_apart(rows: Sequence[FilledRow]) -> list[FilledRow]:
    """Rows whose labels are equal, with the evaluation's name behind."""
    often = Counter(row.label for row in rows)
    return [
        replace(row, label=f"{row.label} ({', '.join(row.evaluations)})") if often[row.label] > 1 else row
        for row in rows
    ]
