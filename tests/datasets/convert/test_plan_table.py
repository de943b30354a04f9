"""Names of files and folders stand in tables as they are, square brackets too."""

from __future__ import annotations

import io

from rich.console import Console
from rich.table import Table

from motionloom.datasets.convert.common.look import Look, SubsetLook
from motionloom.datasets.convert.common.plan import ConversionPlan, Subset
from motionloom.datasets.schema import Dropped
from motionloom.pipeline.evaluation.tables import print_tables


def printed(*tables: Table) -> str:
    console = Console(file=io.StringIO(), width=300)
    for table in tables:
        console.print(table)
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def test_a_plan_shows_brackets() -> None:
    plan: ConversionPlan[None] = ConversionPlan(  # type: ignore[type-var]
        name="mocap[old] -> [bvh]",
        items=[],
        frames={},
        found=5,
        missing=[Dropped(source="take[1].bvh", reason="listed, not here")],
        uncaptioned=["take[x].bvh", "[/]"],
        dropped=[Dropped(source="take[red].bvh", reason="shorter than [limit]")],
        notes=["joint map maps[2].json"],
        subsets={"day[b]": Subset()},
        licences={"CC0[x]": 1},
        stop="say what [y] is",
    )
    whole = plan.subset_table()
    assert whole is not None
    look = Look((SubsetLook("hall[c]", 1, 0, 1.7, 1, "+y", 0.01, 1, 0, (30.0,)),))
    text = printed(plan.table(), whole, look.table())
    for words in (
        "mocap[old] -> [bvh]", "take[1].bvh", "take[x].bvh", "[/]", "take[red].bvh", "shorter than [limit]",
        "maps[2].json", "day[b]", "CC0[x]", "hall[c]", "say what [y] is",
    ):  # fmt: skip
        assert words in text, words


def test_figures_show_brackets() -> None:
    console = Console(file=io.StringIO(), width=200)
    print_tables(console, [("run [a]", ["", "[b]"], [["a person [red] waves", "1"]])])
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert all(words in text for words in ("run [a]", "[b]", "a person [red] waves"))
