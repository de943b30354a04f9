"""A filled table as LaTeX: a `tabular` with booktabs' rules, text escaped."""

from __future__ import annotations

from motionloom.pipeline.published.filled import Cell, FilledTable
from motionloom.pipeline.published.words import groups, heading, lines_below

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
