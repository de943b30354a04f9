"""The files of the tables: they parse, they are all there, and their numbers are the papers'."""

from __future__ import annotations

import hashlib
import re

import pytest

from motionloom.datasets.schema import UserError
from motionloom.pipeline.results.paper.compare import paper_table, shipped_tables
from motionloom.pipeline.results.paper.fill import fill
from motionloom.pipeline.results.paper.schema import PaperTable

NAMES = list(shipped_tables())

PRINTED = "ba59474d25be4f635b6e9373f2d8b9c37e63f171d93db21c0b0ae31bc1c6703b"
"""Of all numbers as the papers print them, which were compared with the papers one by one."""


def test_no_number_of_the_papers_has_changed() -> None:
    found = hashlib.sha256()
    for name in NAMES:
        table = paper_table(name)
        titles = [column.title for column in table.columns if column.printed]
        for row in table.rows:
            texts = ["-" if cell is None else cell.text for cell in row.printed()]
            found.update(f"{name} {row.method} {titles} {texts}\n".encode())
    assert found.hexdigest() == PRINTED


def test_every_table_of_the_papers_is_there() -> None:
    humantomato = [f"humantomato/{n}" for n in (*range(1, 9), *range(10, 23))]
    assert [*humantomato, *(f"ude/{n}" for n in range(1, 6))] == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_tables_parse_and_name_their_source(name: str) -> None:
    table = paper_table(name)
    path = shipped_tables()[name]
    paper = {"humantomato": "HumanTOMATO", "ude": "UDE"}[name.split("/")[0]]
    assert path.read_text(encoding="utf-8").startswith(f"# {paper}, Table {name.split('/')[1]}.")
    assert re.fullmatch(r"(appendix )?[A-Z\d.]+(, appendix [A-Z])?", table.section)
    # Each row of the paper has a number, and the same table without runs has the paper's rows alone.
    assert all(any(row.printed()) for row in table.rows)
    filled = fill(name, table)
    assert [row.label for row in filled.rows] == [row.method for row in table.rows]
    assert {row.source for row in filled.rows} == {"paper"}


def test_an_unknown_table_names_the_nearest() -> None:
    with pytest.raises(UserError, match=r"humantomatoes/7: .*'humantomato/7'"):
        paper_table("humantomatoes/7")
    with pytest.raises(UserError, match="valid names: humantomato/1, "):
        paper_table("x")
    with pytest.raises(UserError, match=r"nowhere\.yaml: "):
        paper_table("nowhere.yaml")


BASE = {
    "title": "t",
    "section": "1",
    "measured": {"data": "d"},
    "columns": [{"name": "a", "figure": "x"}],
    "rows": [{"method": "m", "paper": "1.50", "ours": {"tokenizer": {"kind": "vq"}}}],
}
ROW = BASE["rows"][0]
WRONG = {
    "a word among the numbers": ({"rows": [{**ROW, "paper": "about 3"}]}, "'about 3' is no number"),
    "too many numbers": ({"rows": [{**ROW, "paper": "1 | 2"}]}, "row 'm' has 2 numbers for 1 columns"),
    "neither figure nor why": ({"columns": [{"name": "a"}]}, "give either figure"),
    "no row of three": ({"rows": [{"method": "m", "paper": "1"}]}, "give one of ours"),
    "conditions on nothing": ({"rows": [{**ROW, "ours": {"setting": {"a": 1}}}]}, "needs a condition"),
    "unknown role": ({"rows": [{**ROW, "ours": {"tokeniser": {"kind": "vq"}}}]}, "did you mean 'tokenizer'"),
    "columns of one name": ({"columns": BASE["columns"] * 2}, "two columns are called 'a'"),
    "unknown data set": ({"columns": [{"name": "a", "figure": "x", "data": "GRAB"}]}, "no data set 'GRAB'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_refused(case: str) -> None:
    change, message = WRONG[case]
    with pytest.raises(UserError, match=re.escape(message)):
        PaperTable.parse({**BASE, **change}, "table.yaml")
    (cell,) = PaperTable.parse(BASE, "table.yaml").rows[0].printed()
    assert cell is not None and (cell.text, cell.mean, cell.decimals) == ("1.50", 1.5, 2)
