"""The files of the tables: they parse, they are all there, and their numbers are the papers'."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from motionloom.datasets.schema import UserError
from motionloom.pipeline.published.fill import fill
from motionloom.pipeline.published.schema import PaperTable
from motionloom.pipeline.published.shipped import paper_table, shipped_tables
from motionloom.pipeline.runs.shipped import shipped_recipes
from motionloom.pipeline.store.yaml import load_yaml

NAMES = list(shipped_tables())

# Typed from the papers a second time, by hand, row by row; "-" is printed where there is no number.
SEVEN = """
Vanilla VQ (512)  140.66 92.20 46.45 78.23 38.29 31.48 77.21
Vanilla VQ (1024) 139.33 91.77 46.40 76.01 37.34 29.89 71.34
RVQ (512×2)       110.94 73.97 40.01 62.94 31.12 27.28 63.05
H²VQ (512×2)      92.97 62.34 37.20 46.74 24.33 24.59 -
"""
ONE = """
GT            -     0.500 0.708 0.814 0.407 0.578 0.673 2.888 0.768 -     11.087
TEMOS         9.147 0.279 0.442 0.555 0.258 0.389 0.444 5.482 0.928 1.195 9.764
T2M-GPT       1.366 0.368 0.553 0.655 0.310 0.446 0.527 4.316 0.881 2.356 10.753
MDM           3.800 0.352 0.547 0.634 0.310 0.430 0.530 4.050 0.840 2.530 11.400
MLD           3.407 0.385 0.571 0.683 0.333 0.477 0.561 3.901 0.883 2.448 10.420
MotionDiffuse 1.129 0.391 0.587 0.695 0.368 0.493 0.584 3.950 0.829 1.654 10.580
HumanTOMATO   1.174 0.416 0.603 0.703 0.399 0.555 0.638 3.894 0.809 1.732 10.812
"""
UDE_TWO = """
GT       0.237  17.10 10.60 8.19 7.45 -    -    0.00 0.00 0.00 0.00
FACT     0.2209 35.35 22.11 5.94 6.18 -    -    0.26 0.04 0.70 0.11
Bailando 0.2332 28.16 9.62  7.83 6.34 -    -    0.27 0.03 0.32 0.13
Ours     0.2311 17.25 8.69  7.78 5.81 4.27 2.82 0.29 0.03 0.28 0.12
"""
FIFTEEN = """
Vanilla VQ (512)  140.66 92.20 46.45 58.23 47.72 17.03 23.73 19.99 26.46
Vanilla VQ (1024) 139.33 91.77 46.40 57.30 46.79 17.01 23.54 19.71 26.35
RVQ               110.94 73.97 40.01 40.63 35.84 14.46 21.22 17.76 23.75
H²VQ              92.97 62.34 37.20 34.21 30.76 14.05 18.95 16.53 20.72
"""
FIVE_OF_UDE = """
vq-decoder        8.11 25.01 27.66 4.92 4.28 6.77 28.44 15.70 6.13 4.07
diffusion-decoder 8.12 25.18 23.93 3.15 6.98 7.17 18.43 10.39 6.84 5.03
"""


@pytest.mark.parametrize(
    ("name", "typed"),
    [
        ("humantomato/7", SEVEN),
        ("humantomato/1", ONE),
        ("humantomato/15", FIFTEEN),
        ("ude/2", UDE_TWO),
        ("ude/5", FIVE_OF_UDE),
    ],
)
def test_whole_tables_typed_twice(name: str, typed: str) -> None:
    table = paper_table(name)
    width = sum(column.printed for column in table.columns)
    wanted = []
    for line in typed.strip().splitlines():
        method, *values = line.rsplit(maxsplit=width)
        wanted.append((method.strip(), values))
    found = []
    for row in table.rows:
        cells = ["-" if cell is None else cell.text.split(" ± ")[0] for cell in row.printed()]
        found.append((row.method, cells))
    assert found == wanted


SINGLE = [
    ("humantomato/2", "RVQ", "v.-err.", "0.605"),
    ("humantomato/2", "VQ", "Top3", "0.395"),
    ("humantomato/3", "H²VQ", "1024", "83.9"),
    ("humantomato/3", "RVQ", "4096", "116.8"),
    ("humantomato/4", "Diffusion", "Matching-score", "13.410"),
    ("humantomato/4", "Ours", "FID", "1.044"),
    ("humantomato/5", "Separate", "FID", "2.209 ± .047"),
    ("humantomato/5", "Ours", "TMA-R-Precision (256) Top1", "0.399 ± .000"),
    ("humantomato/6", "separate face modeling ✗", "body-hand MPJPE", "108.31"),
    ("humantomato/6", "separate face modeling ✓", "face FID", "0.462"),
    ("humantomato/8", "GT", "FID", "0.002"),
    ("humantomato/8", "CLIP ✗", "TMA-Matching-score", "0.844"),
    ("humantomato/8", "TMA ✗", "FID", "1.290"),
    ("humantomato/10", "Protocol C", "M2T Recall@1", "0.407"),
    ("humantomato/10", "Protocol B", "T2M Recall@10", "0.401"),
    ("humantomato/11", "Protocol D", "T2M Recall@1", "0.774"),
    ("humantomato/12", "B, TEMOS", "M2T Recall@2", "0.135"),
    ("humantomato/12", "D, TMA", "M2T Recall@10", "0.985"),
    ("humantomato/13", "T2M-GPT", "TMA-R-Precision (256) Top3", "0.527 ± 0.014"),
    ("humantomato/13", "MotionDiffuse", "R-Precision (32) Top1", "0.391 ± 0.024"),
    ("humantomato/14", "MDM", "Diversity", "11.400 ± 0.370"),
    ("humantomato/14", "HumanTOMATO", "MModality", "1.732 ± 0.194"),
    ("humantomato/16", "RVQ", "Accel. Hand", "10.37"),
    ("humantomato/16", "H²VQ", "PA-MPJPE Body", "13.95"),
    ("humantomato/17", "Vanilla VQ (512)", "MPJPE (Body)", "77.209"),
    ("humantomato/18", "T2M-GPT w/ H²VQ", "Matching Score", "3.917"),
    ("humantomato/18", "GT", "TMA-Matching Score", "0.768"),
    ("humantomato/19", "TMA ✓", "TMA-R-Precision (256) Top2", "0.223"),
    ("humantomato/19", "CLIP ✗", "R-Precision (256) Top1", "0.169"),
    ("humantomato/20", "TMA B = 256", "Top5", "0.795 ± .001"),
    ("humantomato/21", "Guo et al. (2022) B = 256", "Top10", "0.659 ± .003"),
    ("humantomato/22", "Modeling Separately", "R-Precision (32) Top2", "0.551 ± 0.003"),
    ("ude/1", "Ours", "Top-5 Acc.", "26.06 ± 1.33"),
    ("ude/1", "TM2T", "MM_k", "2.63 ± 2.464"),
    ("ude/1", "GT", "FID_k", "4.84"),
    ("ude/2", "Ours", "Beat Align", "0.2311 ± 0.01937"),
    ("ude/2", "Ours", "AVE (root)", "0.12 ± 0.0596"),
    ("ude/3", "Ours (gru)", "Audio-to-Motion Div_m", "3.72"),
    ("ude/4", "ours+z", "Text-to-Motion FID_m", "4.49"),
]


@pytest.mark.parametrize(("name", "method", "column", "wanted"), SINGLE)
def test_single_numbers(name: str, method: str, column: str, wanted: str) -> None:
    filled = fill(name, paper_table(name))
    heads = [f"{head.group} {head.name}".strip() for head in filled.heads]
    row = next(row for row in filled.rows if row.method == method)
    cell = row.cells[heads.index(column)]
    assert cell is not None and cell.text == wanted
    assert cell.mean == float(wanted.split(" ")[0])


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


def test_numbers_that_two_tables_share_are_equal() -> None:
    """The papers print some figures twice; a slip of the hand in one of them would show."""

    def numbers(name: str, method: str) -> list[float | None]:
        row = next(row for row in paper_table(name).rows if row.method == method)
        return [None if cell is None else cell.mean for cell in row.printed()]

    for method in ("GT", "TEMOS", "T2M-GPT", "MotionDiffuse", "MDM", "MLD", "HumanTOMATO"):
        one, thirteen, fourteen = (numbers(f"humantomato/{n}", method) for n in (1, 13, 14))
        assert thirteen + fourteen == one[:7] + one[7:]
    assert numbers("humantomato/8", "TMA ✓") == numbers("humantomato/1", "HumanTOMATO")[:9]
    assert numbers("humantomato/22", "HumanTOMATO") == numbers("humantomato/13", "HumanTOMATO")
    assert numbers("humantomato/18", "T2M-GPT w/o H²VQ")[:7] == numbers("humantomato/13", "T2M-GPT")
    assert (
        numbers("humantomato/7", "Vanilla VQ (512)")[:3] == numbers("humantomato/15", "Vanilla VQ (512)")[:3]
    )
    assert (
        numbers("humantomato/7", "Vanilla VQ (512)")[3:6] == numbers("humantomato/16", "Vanilla VQ (512)")[:3]
    )
    assert numbers("ude/3", "Ours (gpt)")[:2] == numbers("ude/4", "ours")[:2]
    assert numbers("ude/4", "ours") == numbers("ude/5", "vq-decoder")
    for protocol in "ABCD":
        assert numbers("humantomato/12", f"{protocol}, TMA") == numbers(
            "humantomato/10", f"Protocol {protocol}"
        )
    # R-Precision is the recall of texts by motions: protocol C is among 256, D among 32.
    for table, recall in ((20, 10), (21, 11)):
        for size, protocol in ((256, "C"), (32, "D")):
            found = numbers(f"humantomato/{table}", f"TMA B = {size}")
            assert found == numbers(f"humantomato/{recall}", f"Protocol {protocol}")[5:]
    assert numbers("humantomato/1", "GT")[4:7] == numbers("humantomato/10", "Protocol C")[5:8]


def test_tables_are_no_recipes() -> None:
    assert not any("tables" in name for name in shipped_recipes())


def test_an_unknown_table_names_the_nearest() -> None:
    with pytest.raises(
        UserError, match=r"--table humantomatoes/7: no such table; did you mean 'humantomato/7'\?"
    ):
        paper_table("humantomatoes/7")
    with pytest.raises(UserError, match="no such table; motionloom evaluate --tables lists them"):
        paper_table("x")
    with pytest.raises(UserError, match=r"nowhere\.yaml: cannot be read"):
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
    "conditions on nothing": (
        {"rows": [{**ROW, "ours": {"setting": {"a": 1}}}]},
        "needs a condition on one of",
    ),
    "unknown role": ({"rows": [{**ROW, "ours": {"tokeniser": {"kind": "vq"}}}]}, "did you mean 'tokenizer'"),
    "columns of one name": ({"columns": BASE["columns"] * 2}, "two columns are called 'a'"),
    "unknown data set": ({"columns": [{"name": "a", "figure": "x", "data": "GRAB"}]}, "no data set 'GRAB'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_refused(case: str) -> None:
    change, message = WRONG[case]
    with pytest.raises(UserError, match=re.escape(message)):
        PaperTable.parse({**BASE, **change}, "table.yaml")


def test_the_base_of_the_wrong_files_is_right() -> None:
    (cell,) = PaperTable.parse(BASE, "table.yaml").rows[0].printed()
    assert cell is not None and (cell.text, cell.mean, cell.decimals) == ("1.50", 1.5, 2)


def test_the_document_names_every_table() -> None:
    text = (Path(__file__).resolve().parents[3] / "docs" / "tables.md").read_text(encoding="utf-8")
    listed = re.findall(r"`((?:humantomato|ude)/\d+)`", text.split("## The tables")[1].split("\n## ")[0])
    assert sorted(listed) == sorted(NAMES)


def test_the_example_of_the_document_parses() -> None:
    text = (Path(__file__).resolve().parents[3] / "docs" / "tables.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```yaml\n(.*?)```", text, re.S)
    assert PaperTable.parse(load_yaml(example, "example"), "example").rows[0].method == "Theirs"
