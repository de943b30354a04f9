"""`motionloom compare`: several runs on one page, without loading any of their models."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from motionloom.datasets.base.files import write_json
from motionloom.pipeline.compare.curves import curve_charts
from motionloom.pipeline.compare.page import comparison_page
from motionloom.pipeline.compare.record import comparison_record
from motionloom.pipeline.compare.runs import open_runs
from motionloom.pipeline.compare.settings import setting_differences
from motionloom.pipeline.compare.tables import compared_tables
from motionloom.pipeline.compare.terminal import print_comparison
from motionloom.pipeline.launch.console import make_console
from motionloom.pipeline.store.files import require_file_place


def compare_runs(
    runs: Sequence[Path],
    out: Path = Path("compare.html"),
    *,
    json_file: Path | None = None,
    console: Console | None = None,
) -> Path:
    """Settings, curves and figures of several runs, finished or not, on one page; returns its path.

    Args:
        runs: Two run folders or more, at most eight.
        out: The page.
        json_file: The same as JSON: figures with who is best, settings that differ, ends of curves.
        console: Where the short table goes; standard output by default.
    """
    console = console or make_console()
    for path in (out, json_file):
        if path is not None:
            require_file_place(path)
    opened = open_runs(runs)
    differences, tables = setting_differences(opened), compared_tables(opened)
    page = comparison_page(opened)
    page.write(out)
    if json_file is not None:
        write_json(json_file, comparison_record(opened, differences, curve_charts(opened), tables))
    print_comparison(console, opened, differences, tables)
    for path in (out, json_file):
        if path is not None:
            console.print(str(path.resolve()), soft_wrap=True)
    return out
