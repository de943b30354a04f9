"""Which of our own models' figures are the best of a column: only among those that were measured alike."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from motionloom.pipeline.published.filled import Cell, FilledRow, Head


def mark_best(rows: Sequence[FilledRow], heads: Sequence[Head]) -> tuple[FilledRow, ...]:
    """The rows with the best figures marked: of models of ours, two or more of them measured alike.

    The paper's rows, recorded motion and other answers that need no model are never ranked. Equal figures
    are marked together; the figure as it is printed decides.
    """
    best: dict[int, set[int]] = defaultdict(set)
    for at, head in enumerate(heads):
        if head.better is None:
            continue
        for group in _measured_alike(rows, at).values():
            if len(group) < 2:
                continue
            values = {number: float(cell.text.split(" ")[0]) for number, cell in group}
            wanted = min(values.values()) if head.better == "lower" else max(values.values())
            for number, value in values.items():
                if value == wanted and len(set(values.values())) > 1:
                    best[number].add(at)
    return tuple(row.marked(best[number]) for number, row in enumerate(rows))


def _measured_alike(rows: Sequence[FilledRow], at: int) -> dict[str, list[tuple[int, Cell]]]:
    """Numbers and cells of our rows in column `at`, by how they were measured."""
    groups: dict[str, list[tuple[int, Cell]]] = defaultdict(list)
    for number, row in enumerate(rows):
        if row.source != "ours" or not row.alike:
            continue
        cell, alike = row.cells[at], row.alike[at]
        if cell is not None and alike is not None:
            groups[alike].append((number, cell))
    return groups
