"""A matrix of counts as an HTML table: what it is down the side, what it was taken for along the top.

Cells are shaded by their share of the row; the numbers stay text, so that nothing depends on colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from motionloom.datasets.schema import UserError


def matrix_table(
    rows: Sequence[str],
    columns: Sequence[str],
    counts: Sequence[Sequence[int]],
    *,
    title: str = "",
    corner: str = "",
) -> str:
    """A table of `counts` [R, C]; a cell whose row and column have one name is a right answer."""
    if len(counts) != len(rows) or any(len(row) != len(columns) for row in counts):
        raise UserError(
            f"matrix '{title}': {len(rows)} rows and {len(columns)} columns do not fit its counts"
        )
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in columns)
    body = []
    for name, values in zip(rows, counts, strict=True):
        total = sum(values)
        cells = "".join(
            _cell(value, total, name == column) for column, value in zip(columns, values, strict=True)
        )
        body.append(f'<tr><th scope="row">{escape(name)}</th>{cells}</tr>')
    caption = f"<caption><span>{escape(title)}</span></caption>" if title else ""
    return (
        f'<div class="scroll"><table class="matrix">{caption}<thead><tr>'
        f'<th class="corner">{escape(corner)}</th>{head}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _cell(value: int, total: int, right: bool) -> str:
    if not value:
        return '<td class="none">·</td>'
    share = 100 * value / total
    kind = "right" if right else "wrong"
    return f'<td class="{kind}" style="--share:{share:.0f}%" title="{share:.0f} % of the row">{value:,}</td>'
