"""Both forms of a filled table, read back; and what the command line does with it."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from motionloom.pipeline.results.paper.compare import shipped_tables
from motionloom.pipeline.results.paper.filled import Cell, FilledRow, FilledTable
from motionloom.pipeline.results.paper.schema import PaperTable

PAPER = PaperTable.parse(
    {
        "title": "a & b | 50 %",
        "section": "4",
        "measured": {"data": "D"},
        "columns": [
            {"group": "G_1", "name": "x", "unit": "mm/frame²", "better": "lower", "figure": "x"},
            {"group": "G_1", "name": "y", "better": "higher", "figure": "y"},
            {"name": "z|z", "figure": "z", "printed": False},
        ],
        "rows": [{"method": "m_1", "paper": "1.50 ± .20 | -", "why": "none"}],
    },
    "p.yaml",
)


TABLE = FilledTable(
    "p/1",
    PAPER,
    (
        FilledRow("paper", "m_1", "m_1", (Cell("1.50 ± .20"), None, None)),
        FilledRow("ours", "m_1", "[red]r a|b", (Cell("2.0", best=True), Cell("0.1"), None)),
        FilledRow("reference", "", "chance", (None, Cell("0.5"), None)),
    ),
    differences={"r e": [("data", "S", "D"), ("clips", "3", None)]},
    notes=("A note [n].",),
)


def test_markdown_has_as_many_cells_in_every_row() -> None:
    lines = TABLE.markdown().splitlines()
    assert lines[0].startswith(r"**p Table 1: ") and r" \| 50 % " in lines[0]
    rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in lines if line.startswith("|")]
    assert {len(row) for row in rows} == {5} and len(rows) == 5
    assert [cell.strip() for cell in rows[0]] == ["", "", "G_1 x (mm/frame²) ↓", "G_1 y ↑", r"z\|z"]
    assert [cell.strip() for cell in rows[3]] == [r"\[red]r a\|b", "ours", "**2.0**", "0.1", ""]
    assert any(line.startswith("- r e: data S (paper: D); clips 3 ") for line in lines)
    assert any(line.startswith(r"- z\|z: ") for line in lines)


Call = Callable[..., Any]


def test_the_command_prints_and_writes(baselines: Callable[..., Path], call: Call, tmp_path: Path) -> None:
    run, other = baselines("one"), baselines("two")
    shown = call("evaluate", "--table", "humantomato/7", run, other)
    assert (
        shown.code == 0 and "one vq" in shown.out and "two tokenizer" in shown.out and "140.66" in shown.out
    )
    done = call("evaluate", run, "--table", "humantomato/7", "-o", tmp_path / "new/a.md")
    assert done.code == 0 and done.out.strip() == str(tmp_path / "new/a.md")
    assert (tmp_path / "new/a.md").read_text(encoding="utf-8").startswith("**Human")


def test_a_papers_name_is_all_of_its_tables(call: Call, tmp_path: Path) -> None:
    done = call("evaluate", "--table", "ude", "-o", tmp_path / "all.md")
    assert done.code == 0, done.err
    found = re.findall(r"^\*\*UDE Table (\d)", (tmp_path / "all.md").read_text(encoding="utf-8"), re.M)
    assert found == ["1", "2", "3", "4", "5"]
    shown = call("evaluate", "--table", "list")
    assert shown.code == 0
    assert re.findall(r"(?:humantomato|ude)/\d+", shown.out) == list(shipped_tables())


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--table", "humantomato/70"], "no such table; did you mean 'humantomato/7'?"),
        (["--table", "ude/1", "nowhere"], "nowhere: no such folder"),
        (["--table", "ude/1", "--clips", "4"], "--clips, --repeats and --device measure anew"),
        (["--table", "ude/1", "-o", "x.csv"], "x.csv: a table is written as Markdown"),
        (["--table", "list", "runs"], "--table list names the tables alone"),
        (["runs", "-o", "x.md"], "--out is of a table"),
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
