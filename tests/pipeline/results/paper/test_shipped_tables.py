"""The files of the tables: they parse, they are all there, and their numbers are the papers'."""

from __future__ import annotations

import hashlib
import re

import pytest

from motionloom.datasets.schema import UserError
from motionloom.pipeline.results.paper.compare import paper_table, shipped_tables
from motionloom.pipeline.results.paper.fill import fill

NAMES = list(shipped_tables())

PRINTED = "ba59474d25be4f635b6e9373f2d8b9c37e63f171d93db21c0b0ae31bc1c6703b"
"""Of all numbers as the papers print them, which were compared with the papers one by one."""


def test_no_number_of_the_papers_has_changed() -> None:
    found = hashlib.sha256()
    for name in NAMES:
        table = paper_table(name)
        titles = [column.title for column in table.columns if column.printed]
        for row in table.rows:
            texts = [text or "-" for text in row.printed()]
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
    number = r"\d*\.?\d+( ± \d*\.?\d+)?"
    for row in table.rows:
        assert any(row.printed()) and all(re.fullmatch(number, text) for text in row.printed() if text)
    filled = fill(name, table)
    assert [row.label for row in filled.rows] == [row.method for row in table.rows]
    assert {row.source for row in filled.rows} == {"paper"}
    numbers = [cell.text.split(" ")[0] for row in filled.rows for cell in row.cells if cell]
    assert all(number in filled.markdown() for number in numbers)
    titles = [column.title for column in table.columns]
    assert len(set(titles)) == len(titles)
    assert all((column.figure is None) == bool(column.why) for column in table.columns)
    assert all(column.printed or column.figure for column in table.columns)
    assert {column.data for column in table.columns} - {""} <= {one.name for one in table.data}
    for row in table.rows:
        assert len(row.printed()) == sum(column.printed for column in table.columns)
        assert row.recorded + (row.ours is not None) + bool(row.why) == 1, "a model, recorded, or why none"
        assert row.ours is None or any(row.ours.conditions().values())


def test_an_unknown_table_names_the_nearest() -> None:
    with pytest.raises(UserError, match=r"humantomatoes/7: .*'humantomato/7'"):
        paper_table("humantomatoes/7")
    with pytest.raises(UserError, match="valid names: humantomato/1, "):
        paper_table("x")
