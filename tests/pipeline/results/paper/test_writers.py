"""Both forms of a filled table, read back; and what the command line does with it."""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.evaluation.figures import CHANCE, RECORDED, STILL
from motionloom.pipeline.results.paper.compare import paper_table, shipped_tables
from motionloom.pipeline.results.paper.fill import Evaluation, evaluations_of, fill
from motionloom.pipeline.results.paper.filled import Cell, FilledRow, FilledTable
from motionloom.pipeline.results.paper.schema import Measure, PaperTable

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
        (["--table", "ude/1", "-o", "x.csv"], "x.csv: name a file that ends in .md"),
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


# Names of the tables' figures against what real runs write, and evaluations of a tokenizer alone.

OTHER_STAGES = (
    "evaluator.",
    "face_evaluator.",
    "reconstruction.evaluator.",
    "reconstruction.face_evaluator.",
)
"""Begin the names of figures by judges that these runs do not have."""


def require_all(evaluation: Evaluation, measure: Measure) -> None:
    """Every figure that a table names was measured."""
    wanted = set()
    for table in map(paper_table, shipped_tables()):
        for column in table.columns:
            if column.figure is not None and column.of == measure:
                values = [row.values for row in table.rows if row.values] or [{}]
                wanted |= {column.figure.format(**one) for one in values}
    assert wanted
    absent = {name for name in wanted if evaluation.file.of(name) is None}
    assert all(name.startswith(OTHER_STAGES) or name == "face.vertex" for name in absent), absent


@pytest.fixture
def run(small_run: Any, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small_run.folder, tmp_path / "run"))


@pytest.mark.slow
def test_figures_of_texts_and_retrieval(small_run: Any, run: Path, tmp_path: Path, call: Call) -> None:
    recipe = tmp_path / "more.yaml"
    recipe.write_text(
        f"extends: {small_run.recipe}\nname: small\nstages:\n  evaluate: {{repeats: 2}}\n"
        "  alone: {kind: evaluate, clips: 6, inputs: {face_tokenizer: null, tma: null, generators: []}}\n"
    )
    for stage in ("evaluate", "alone"):
        done = call("run", recipe, "--out", run, "--until", stage)
        assert done.code == 0, done.err
    assert call("retrieval", run).code == 0
    evaluation, alone = evaluations_of(run, "run", ["evaluate"])
    require_all(evaluation, "evaluate")
    require_all(evaluations_of(run, "run", ["retrieval"])[0], "retrieval")
    assert {role: stage.name for role, stage in evaluation.about.items()} == {
        "tokenizer": "tokenizer",
        "face_tokenizer": "face_tokenizer",
        "generator": "gpt",
        "face_generator": "face_gpt",
    }
    # Beside every figure stand the answers that need no model.
    for name, row in (("tma.m2t_r1", CHANCE), ("tma.m2t_r1", RECORDED), ("tma.fid", STILL)):
        assert evaluation.file.of(name, row) is not None
    # A tokenizer alone is measured as it is beside generators, and nothing is generated.
    errors = [one for one in evaluation.file.figures if one.name.startswith("reconstruction.mpjpe")]
    assert errors and all(one in alone.file.figures for one in errors)
    assert {one.name.split(".")[0] for one in alone.file.figures} == {"reconstruction"}
    for name, label in (("humantomato/7", "run tokenizer"), ("humantomato/13", "run gpt")):
        labels = [row.label for row in fill(name, paper_table(name), [run]).rows if row.source == "ours"]
        assert labels == [label]
    nothing = tmp_path / "nothing.yaml"
    nothing.write_text(
        f"extends: {small_run.recipe}\nname: small\nstages:\n"
        "  alone: {kind: evaluate, inputs: {tokenizer: null, generators: []}}\n"
    )
    done = call("run", nothing, "--out", run, "--until", "alone")
    assert done.code == 2 and "'alone': no tokenizer and" in done.err


@pytest.mark.slow
def test_figures_of_dances(ude_run: Any, tmp_path: Path, call: Call) -> None:
    run = Path(shutil.copytree(ude_run.folder, tmp_path / "run"))
    done = call("run", ude_run.recipe, "--out", run, "--until", "evaluate_dances")
    assert done.code == 0, done.err
    (evaluation,) = evaluations_of(run, "run", ["evaluate_dances"])
    require_all(evaluation, "evaluate_dances")
    assert evaluation.about["generator"].name == "ude"
    table = fill("ude/2", paper_table("ude/2"), [run])
    (row,) = [row for row in table.rows if row.source == "ours"]
    figure = evaluation.file.of("beat_align.bailando")
    assert row.method == "Ours" and row.cells[0] is not None and figure is not None
    assert row.cells[0].text == "–" and figure.value > 0, "of fewer than ten dances"


# The files of the tables: they parse, they are all there, and their numbers are the papers'.

NAMES = list(shipped_tables())

PRINTED = "ba59474d25be4f635b6e9373f2d8b9c37e63f171d93db21c0b0ae31bc1c6703b"
"""sha256 of all numbers as the papers print them, which were compared with the papers one by one."""


def test_no_number_of_the_papers_has_changed() -> None:
    found = hashlib.sha256()
    for name in NAMES:
        table = paper_table(name)
        titles = [column.title for column in table.columns if column.printed]
        for row in table.rows:
            texts = [text or "-" for text in row.printed()]
            found.update(f"{name} {row.method} {titles} {texts}\n".encode())
    assert found.hexdigest() == PRINTED


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
