"""A filled table as Markdown, as LaTeX, and as a table for terminals."""

from __future__ import annotations

import re
from collections.abc import Callable

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from motionloom.pipeline.results.paper.filled import Cell, FilledTable, groups, heading, lines_below, who


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


WRITERS: dict[str, Callable[[FilledTable], str]] = {"markdown": markdown, "latex": latex}
SUFFIXES = {".md": "markdown", ".tex": "latex"}
