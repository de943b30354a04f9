"""How parts of a filled table read, the same in every form."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from motionloom.pipeline.published.filled import FilledRow, FilledTable, Head

ARROWS = {"lower": " ↓", "higher": " ↑", None: ""}

_LONG = 40
"""What the paper's measuring is called in more letters is not repeated with every difference."""


def heading(head: Head) -> str:
    """A column's name with its unit and the direction of better."""
    unit = f" ({head.unit})" if head.unit else ""
    return f"{head.name}{unit}{ARROWS[head.better]}"


def groups(heads: Sequence[Head]) -> list[tuple[str, int]]:
    """(title, columns) of neighbouring columns of one group, in order; none where no column has a group."""
    out: list[tuple[str, int]] = []
    for head in heads:
        if out and out[-1][0] == head.group:
            out[-1] = (head.group, out[-1][1] + 1)
        else:
            out.append((head.group, 1))
    return out if any(title for title, _ in out) else []


def who(row: FilledRow) -> str:
    """Whose row it is, in one word."""
    return {"paper": "paper", "ours": "ours", "missing": "ours", "reference": "no model"}[row.source]


def lines_below(table: FilledTable) -> Iterator[str]:
    """Notes, then what was measured otherwise, one line for each evaluation."""
    yield from table.notes
    if alone := [head.title for head in table.heads if not head.printed]:
        yield f"{', '.join(alone)}: not in the paper, a figure of ours alone."
    found: dict[tuple[str, str], list[str]] = {}
    for one in table.differences:
        theirs = "the paper does not say" if one.paper is None else f"paper: {one.paper}"
        if one.paper is not None and len(one.paper) > _LONG and one.paper in table.measured.values():
            theirs = "paper: see above"
        found.setdefault((one.run, one.evaluation), []).append(f"{one.what} {one.ours} ({theirs})")
    for (run, evaluation), said in found.items():
        yield f"{run} {evaluation}: {'; '.join(said)}"
