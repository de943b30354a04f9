"""Each form of a filled table, read back; and what the command line does with it."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from motionloom.pipeline import compare_with_paper
from motionloom.pipeline.results.paper.compare import paper_table, shipped_tables
from motionloom.pipeline.results.paper.fill import fill
from motionloom.pipeline.results.paper.filled import Cell, Difference, FilledRow, FilledTable, Head
from motionloom.pipeline.results.paper.writers import WRITERS, latex, markdown, print_text

TABLE = FilledTable(
    name="p/1",
    paper="P Table 1",
    title="a & b | 50 % of #1",
    section="4",
    measured={"data": "D"},
    heads=(
        Head("G_1", "x", "mm/frame²", "lower", True),
        Head("G_1", "y", "", "higher", True),
        Head("", "z|z", "", None, False),
    ),
    rows=(
        FilledRow("paper", "m_1 ✗", "m_1 ✗", (Cell("1.50 ± .20", 1.5, 0.2), None, None)),
        FilledRow(
            "ours",
            "m_1 ✗",
            "r{1} a|b",
            (Cell("2.0", 2.04, None, True), Cell("0.1", 0.1), Cell("7", 7.0)),
            "r{1}",
            ("a|b",),
            ("e",),
            ("k", "k", None),
        ),
        FilledRow("missing", "m2", "missing", (None, None, None)),
        FilledRow("reference", "", "chance", (None, Cell("0.5", 0.5), None), "r{1}"),
    ),
    differences=(Difference("r{1}", "e", "data", "S", "D"), Difference("r{1}", "e", "clips", "3", None)),
    notes=("A note of 5 %.",),
)


def test_markdown_has_as_many_cells_in_every_row() -> None:
    lines = markdown(TABLE).splitlines()
    assert lines[0] == r"**P Table 1: a & b \| 50 % of #1 (section 4)**"
    rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in lines if line.startswith("|")]
    assert {len(row) for row in rows} == {5} and len(rows) == 6
    assert [cell.strip() for cell in rows[0]] == ["", "", "G_1 x (mm/frame²) ↓", "G_1 y ↑", r"z\|z"]
    assert [cell.strip() for cell in rows[3]] == [r"r{1} a\|b", "ours", "**2.0**", "0.1", "7"]
    assert (
        "- A note of 5 %." in lines
        and "- r{1} e: data S (paper: D); clips 3 (the paper does not say)" in lines
    )
    assert r"- z\|z: not in the paper, a figure of ours alone." in lines


def test_latex_is_escaped_and_balanced() -> None:
    found = latex(TABLE)
    assert r"\caption{P Table 1: a \& b \textbar{} 50 \% of \#1 (section 4)}" in found
    assert r"\multicolumn{2}{c}{G\_1}" in found and r"\cmidrule(lr){2-3}" in found
    assert r"m\_1 $\times$ & 1.50 $\pm$ .20 &  &  \\" in found
    assert r"\quad r\{1\} a\textbar{}b & \textbf{2.0} & 0.1 & 7 \\" in found
    body = found.split(r"\toprule")[1].split(r"\bottomrule")[0]
    for line in body.splitlines():
        if line.endswith(r"\\") and "multicolumn" not in line:
            assert len(re.findall(r"(?<!\\)&", line)) == 3
    for name in ("table", "tabular", "flushleft"):
        assert found.count(rf"\begin{{{name}}}") == found.count(rf"\end{{{name}}}") == 1
    plain = re.sub(r"\\[{}]", "", found)
    assert plain.count("{") == plain.count("}")
    assert found.index(r"\midrule" + "\nchance") > 0


def test_text_marks_the_best_and_keeps_brackets(capsys: pytest.CaptureFixture[str]) -> None:
    table = FilledTable(
        "p/1", "P", "t", "4", {}, (Head("", "[a]", "", "lower", True),),
        (FilledRow("ours", "m", "[red]r", (Cell("1", 1.0, None, True),)),), (), ("[n]",),
    )  # fmt: skip
    print_text(table, Console(width=80))
    found = capsys.readouterr().out
    assert "[a] ↓" in found and re.search(r"\[red\]r +1\*", found) and "- [n]" in found


@pytest.mark.parametrize("name", list(shipped_tables()))
def test_every_table_is_written_in_every_form(name: str) -> None:
    filled = fill(name, paper_table(name))
    numbers = [cell.text.split(" ")[0] for row in filled.rows for cell in row.cells if cell]
    for form, write in WRITERS.items():
        written = write(filled)
        assert numbers and all(number in written for number in numbers), form


Call = Callable[..., Any]


def test_the_command_prints_and_writes(baselines: Callable[..., Path], call: Call, tmp_path: Path) -> None:
    run, other = baselines("one"), baselines("two")
    shown = call("evaluate", "--table", "humantomato/7", run, other)
    assert (
        shown.code == 0 and "one vq" in shown.out and "two tokenizer" in shown.out and "140.66" in shown.out
    )
    for name, start in (("a.md", "**Human"), ("a.tex", "% needs")):
        done = call("evaluate", run, "--table", "humantomato/7", "-o", tmp_path / "new" / name)
        assert done.code == 0 and done.out.strip() == str(tmp_path / "new" / name)
        assert (tmp_path / "new" / name).read_text(encoding="utf-8").startswith(start)


def test_the_list_of_tables(call: Call) -> None:
    shown = call("evaluate", "--tables")
    assert shown.code == 0
    assert re.findall(r"(?:humantomato|ude)/\d+", shown.out) == list(shipped_tables())


def test_a_table_of_ones_own(baselines: Callable[..., Path], tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        "title: mine\nsection: '1'\nmeasured: {data: D}\n"
        "columns: [{name: pose, unit: mm, better: lower, figure: reconstruction.mpjpe}]\n"
        "rows: [{method: any VQ, paper: '1.5', ours: {tokenizer: {kind: [vq, rvq]}}}]\n"
    )
    filled = compare_with_paper(str(path), [baselines()])
    assert [(row.label, row.cells[0] and row.cells[0].text) for row in filled.rows[:3]] == [
        ("any VQ", "1.5"),
        ("bl vq", "140.0"),
        ("bl rvq", "110.0"),
    ]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--table", "humantomato/70"], "no such table; did you mean 'humantomato/7'?"),
        (["--table", "ude/1", "nowhere"], "nowhere: no such folder"),
        (["--table", "ude/1", "--format", "latx"], "--format latx: no such format; choose markdown or latex"),
        (["--table", "ude/1", "--clips", "4"], "--clips, --repeats and --device measure anew"),
        (["--table", "ude/1", "-o", "x.csv"], "x.csv: a table is written as .md or .tex"),
        (["--table", "gone.yaml"], "gone.yaml: cannot be read"),
        (["--tables", "runs"], "--tables lists the tables alone"),
        (["runs", "-o", "x.md"], "--format and --out are of a table"),
        (["one", "two"], "2 run folders to evaluate; name one"),
        ([], "0 run folders to evaluate; name one"),
    ],
)
def test_mistakes_are_one_sentence(
    words: list[str], says: str, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = call("evaluate", *words)
    assert done.code == 2 and says in done.err and len(done.err.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_no_torch_is_imported(baselines: Callable[..., Path]) -> None:
    code = (
        "import sys\nfrom pathlib import Path\nfrom motionloom.pipeline import compare_with_paper\n"
        "compare_with_paper('humantomato/7', [Path(sys.argv[1])])\n"
        "print(sorted({'torch', 'numpy'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, str(baselines())], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip().endswith("[]") and "140.00" in done.stdout
