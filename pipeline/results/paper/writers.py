"""A filled table as Markdown, CSV, LaTeX and JSON, and as a table for terminals."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable
from dataclasses import asdict

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from motionloom.pipeline.results.paper.filled import (
    Cell,
    FilledRow,
    FilledTable,
    groups,
    heading,
    lines_below,
    who,
)

WIDTH = 200
"""Characters of a line of text in a file."""


def markdown(table: FilledTable) -> str:
    """A pipe table, the best figures bold, and what is to be known as a list below."""
    grouped = bool(groups(table.heads))
    names = [f"{head.group} {heading(head)}".strip() if grouped else heading(head) for head in table.heads]
    names = [_plain_markdown(name) for name in names]
    rows = [["", "", *names], ["---", "---", *("---:" for _ in names)]]
    for row in table.rows:
        cells = [_marked(cell, "**") for cell in row.cells]
        rows.append([_plain_markdown(row.label), who(row), *cells])
    body = [f"| {' | '.join(row)} |" for row in rows]
    below = [f"- {_plain_markdown(line)}" for line in lines_below(table)]
    return "\n".join([f"**{_plain_markdown(table.caption)}**", "", *body, "", *below, ""])


def csv_text(table: FilledTable) -> str:
    """One line a row, numbers as they are printed; ± in a column of its own where there is one."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    columns = zip(*(row.cells for row in table.rows), strict=True)
    spreads = [any(cell and cell.spread is not None for cell in cells) for cells in columns]
    names = []
    for at, head in enumerate(table.heads):
        names += [head.title, f"{head.title} ±"] if spreads[at] else [head.title]
    writer.writerow(["source", "method", "row", "run", "stages", *names])
    for row in table.rows:
        values: list[str] = []
        for at, cell in enumerate(row.cells):
            mean, _, spread = (cell.text if cell else "").partition(" ± ")
            values += [mean, spread] if spreads[at] else [mean]
        writer.writerow([row.source, row.method, row.label, row.run, " ".join(row.stages), *values])
    return out.getvalue()


def json_text(table: FilledTable) -> str:
    """All there is: numbers as they are and as they are printed, differences and notes."""
    data: dict[str, object] = {
        "table": table.name,
        "title": table.title,
        "section": table.section,
        "measured": dict(table.measured),
        "columns": [asdict(head) for head in table.heads],
        "rows": [_plain(row) for row in table.rows],
        "differences": [asdict(one) for one in table.differences],
        "notes": list(table.notes),
    }
    return json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def text(table: FilledTable, width: int | None = None) -> str:
    """For a terminal of `width` characters."""
    out = io.StringIO()
    console = Console(file=out, width=width or WIDTH, highlight=False, color_system=None)
    print_text(table, console)
    return out.getvalue()


def print_text(table: FilledTable, console: Console) -> None:
    """The table on a console: the best figures with a star, ours below the paper's."""
    grid = Table(title=escape(table.caption), title_justify="left", box=SIMPLE_HEAD)
    grid.add_column("", overflow="fold")
    for head in table.heads:
        group = f"{head.group}\n" if head.group else ""
        grid.add_column(escape(group + heading(head)), justify="right", overflow="fold")
    for row in table.rows:
        indent = "" if row.source in ("paper", "reference") else "  "
        cells = [escape(_marked(cell, "*")) for cell in row.cells]
        grid.add_row(escape(indent + row.label), *cells, style="dim" if row.source == "reference" else None)
    console.print(grid)
    for line in lines_below(table):
        console.print(f"- {escape(line)}")


def _marked(cell: Cell | None, mark: str) -> str:
    if cell is None:
        return ""
    return f"{mark}{cell.text}{mark}" if cell.best and mark != "*" else cell.text + ("*" if cell.best else "")


def _plain_markdown(text: str) -> str:
    """Text that Markdown shows as it is, also in a cell."""
    return re.sub(r"([\\|*<`\[])", r"\\\1", text.replace("\n", " "))


def _plain(row: FilledRow) -> dict[str, object]:
    out = asdict(row)
    del out["alike"]
    return out


# LaTeX: a `tabular` with booktabs' rules.

_ESCAPED = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "±": r"$\pm$",
    "×": r"$\times$",
    "²": r"\textsuperscript{2}",
    "✓": r"$\checkmark$",
    "✗": r"$\times$",
    "↓": r"$\downarrow$",
    "↑": r"$\uparrow$",
}


def escaped(text: str) -> str:
    """Text as LaTeX prints it."""
    return "".join(_ESCAPED.get(letter, letter) for letter in text)


def latex(table: FilledTable) -> str:
    """A `table` environment; needs the packages booktabs and amssymb."""
    columns = len(table.heads)
    lines = [
        "% needs \\usepackage{booktabs} and \\usepackage{amssymb}",
        "\\begin{table}",
        "\\centering",
        f"\\caption{{{escaped(table.caption)}}}",
        f"\\begin{{tabular}}{{l{'r' * columns}}}",
        "\\toprule",
    ]
    if found := groups(table.heads):
        lines += _group_lines(found)
    lines += [_line(["", *(escaped(heading(head)) for head in table.heads)]), "\\midrule"]
    answers = _last_answers(table)
    for number, row in enumerate(table.rows):
        if 0 < number == answers:
            lines.append("\\midrule")
        indent = "" if row.source in ("paper", "reference") else "\\quad "
        lines.append(_line([indent + escaped(row.label), *(_cell(cell) for cell in row.cells)]))
    lines += ["\\bottomrule", "\\end{tabular}", "\\begin{flushleft}", "\\footnotesize"]
    lines += [f"{escaped(line)}\\par" for line in lines_below(table)]
    return "\n".join([*lines, "\\end{flushleft}", "\\end{table}", ""])


def _last_answers(table: FilledTable) -> int:
    """Number of the first of the answers without a model that end the table; its rows where none do."""
    at = len(table.rows)
    while at and table.rows[at - 1].source == "reference":
        at -= 1
    return at


def _group_lines(found: list[tuple[str, int]]) -> list[str]:
    """Headings over several columns, and the rules under them."""
    cells, rules, first = [""], [], 2
    for title, count in found:
        cells.append(f"\\multicolumn{{{count}}}{{c}}{{{escaped(title)}}}")
        if title:
            rules.append(f"\\cmidrule(lr){{{first}-{first + count - 1}}}")
        first += count
    return [_line(cells), " ".join(rules)]


def _cell(cell: Cell | None) -> str:
    if cell is None:
        return ""
    return f"\\textbf{{{escaped(cell.text)}}}" if cell.best else escaped(cell.text)


def _line(cells: list[str]) -> str:
    return " & ".join(cells) + r" \\"


WRITERS: dict[str, Callable[[FilledTable], str]] = {
    "text": text,
    "markdown": markdown,
    "csv": csv_text,
    "latex": latex,
    "json": json_text,
}

SUFFIXES = {".md": "markdown", ".csv": "csv", ".tex": "latex", ".json": "json", ".txt": "text"}
