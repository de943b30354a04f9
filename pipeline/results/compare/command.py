"""`motionloom compare`: several runs on one page, without loading any of their models.

The page says who is compared and what differs, and shows curves and figures; every run keeps one colour
throughout. Names come from folders and recipes and are escaped like all text of a `Page`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from motionloom.datasets.base.progress import duration
from motionloom.pipeline.evaluation.figures import heading
from motionloom.pipeline.launch.console import make_console
from motionloom.pipeline.render.charts import curve_label, log_lines
from motionloom.pipeline.render.page import Cell, Page, Value
from motionloom.pipeline.results.compare.runs import (
    ABSENT,
    ComparedRun,
    ComparedTable,
    StageDifferences,
    compared_tables,
    open_runs,
    setting_differences,
    stage_names,
)
from motionloom.pipeline.store.files import require_file_place
from motionloom.pipeline.store.yaml import setting_text

NO_PAGES = ("report",)
"""Kinds of stages that nothing compared here comes from."""
LETTERS = "ABCDEFGH"
OPEN = 4
"""Charts of a stage that are not folded away."""


def compare_runs(
    runs: Sequence[Path], out: Path = Path("compare.html"), *, console: Console | None = None
) -> Path:
    """Settings, curves and figures of several runs, finished or not, on one page; returns its path.

    Args:
        runs: Two run folders or more, at most eight.
        out: The page.
        console: Where the path goes, and what runs lack; standard output by default.
    """
    console = console or make_console()
    require_file_place(out)
    opened = open_runs(runs)
    names = " and ".join((", ".join(run.label for run in opened[:-1]), opened[-1].label))
    page = Page(f"{names} compared", "Settings that differ, figures on held-out clips, training curves")
    _who(page, opened)
    _settings(page, opened, setting_differences(opened))
    _figures(page, opened, compared_tables(opened))
    _curves(page, opened)
    page.write(out)
    for run in opened:
        if lines := missing_lines(run):
            console.print(f"{run.label}: missing {'; '.join(lines)}", markup=False, soft_wrap=True)
    console.print(str(out.resolve()), soft_wrap=True)
    return out


def missing_lines(run: ComparedRun) -> list[str]:
    """Lines on the stages that a run has not finished."""
    return [f"{s.name}: {s.say()}" for s in run.state.unfinished if s.kind not in NO_PAGES]


def _who(page: Page, runs: Sequence[ComparedRun]) -> None:
    page.add_heading("Runs")
    rows: list[list[Value]] = []
    for run in runs:
        state = run.state
        seconds = [stage.seconds for stage in state.stages if stage.seconds is not None]
        places = dict.fromkeys(stage.hardware for stage in state.stages if stage.hardware)
        done = sum(stage.usable for stage in state.stages)
        rows.append(
            [
                _chip(run),
                state.recipe,
                "–" if state.seed is None else str(state.seed),
                f"{done} of {len(state.stages)}",
                duration(sum(seconds)) if seconds else None,
                "; ".join(places) or None,
            ]
        )
    columns = ["run", "recipe", "seed", "stages finished", "time of these", "ran on"]
    page.add_table(columns, rows, "The runs, each with its colour", pinned=True)
    missing = {run.label: missing_lines(run) for run in runs}
    if any(missing.values()):
        page.add_text("Not all is there yet; the page shows what there is. Missing:")
        page.add_list([f"{label} – {'; '.join(lines)}" for label, lines in missing.items() if lines])


def _settings(page: Page, runs: Sequence[ComparedRun], differences: Sequence[StageDifferences]) -> None:
    page.add_heading("Settings that differ")
    if not differences:
        page.add_text("All settings are equal.")
    for stage in differences:
        title = f"Stage {stage.stage}" if stage.stage else "The recipe"
        if stage.missing:
            absent = f"{title}: not in {', '.join(stage.missing)}"
            page.add_text(f"{absent}." if stage.differences else f"{absent}; equal where it is.")
        if stage.differences:
            rows = [
                [key, *(None if value is ABSENT else setting_text(value) for value in values)]
                for key, values in stage.differences.items()
            ]
            page.add_table(["setting", *(_chip(run) for run in runs)], rows, title, pinned=True)


def _figures(page: Page, runs: Sequence[ComparedRun], tables: Sequence[ComparedTable]) -> None:
    page.add_heading("Figures on held-out clips")
    without = [run.label for run in runs if not run.evaluations]
    if not tables:
        page.add_text("No run has figures yet: their stages that evaluate are not finished.")
        return
    page.add_text(
        "★ is the best of the runs that were measured alike, ☆ the best mean where its 95 % interval still "
        "overlaps another's, so that the difference may be chance; figures without ± were measured once. "
        "Intervals are over clips or, of figures of whole sets, over repeats. "
        "Grey rows are what figures are compared with, and are not ranked."
    )
    sources = [f"{run.label}: {path}" for run in runs for path in run.files.values()]
    several = len({table.stage for table in tables}) > 1
    if without:
        page.add_text(f"Without any figures yet: {', '.join(without)}.")
    for table in tables:
        _figure_table(page, table, several, without)
    with page.folded("Files that the figures were read from"):
        page.add_list(sources)


def _figure_table(page: Page, table: ComparedTable, several: bool, silent: Sequence[str]) -> None:
    lettered = len({row.protocol for row in table.rows}) > 1
    columns = ["", *(["measured"] if lettered else []), *(heading(column) for column in table.columns)]
    rows: list[list[Value]] = []
    for row in table.rows:
        cells: list[Value] = [_chip(row.run)]
        if lettered:
            cells.append(f"as {LETTERS[row.protocol]}")
        for column in table.columns:
            figure, sure = row.figures.get(column.name), row.best.get(column.name)
            if figure is None:
                cells.append(None)
            else:
                cells.append(Cell(figure.text(), best=sure is not None, maybe=sure is False))
        rows.append(cells)
    for reference in table.references:
        name = f"{reference.title} ({', '.join(reference.runs)})" if reference.runs else reference.title
        figures = [reference.figures.get(column.name) for column in table.columns]
        soft = [None if f is None else Cell(f.text(), soft=True) for f in figures]
        rows.append([Cell(name, soft=True), *([None] if lettered else []), *soft])
    title = f"{table.title} – stage {table.stage}" if several else table.title
    page.add_table(columns, rows, title, pinned=True)
    if table.difference:
        page.add_text(table.difference)
    without = [label for label in table.missing if label not in silent]
    if without:
        page.add_text(f"No such figures of: {', '.join(without)}.")


def _curves(page: Page, runs: Sequence[ComparedRun]) -> None:
    page.add_heading("Training curves")
    stages = [stage for stage in stage_names(runs) if any(stage in run.logs for run in runs)]
    if not stages:
        page.add_text("No run has logged a training yet.")
        return
    page.add_text(
        "One colour a run; whole lines are training, dashed ones validation. A loss says something only "
        "between trainings whose losses and data are set alike."
    )
    for stage in stages:
        page.add_subheading(stage)
        kinds = {run.label: state.kind for run in runs if (state := run.state.stage(stage)) is not None}
        if len(set(kinds.values())) > 1:
            listed = "; ".join(f"{label}: {kind}" for label, kind in kinds.items())
            page.add_text(f"Stages of different kinds, so other losses: {listed}.")
        logs = [(run, run.logs.get(stage, [])) for run in runs]
        keys = {key.partition("/")[2] for _, rows in logs for row in rows for key in row if "/" in key}
        figures = sorted(keys, key=lambda key: ("loss" not in key, key))
        for figure in figures[:OPEN]:
            _chart(page, logs, stage, figure)
        if more := figures[OPEN:]:
            with page.folded(f"{len(more)} more curves of {stage}"):
                for figure in more:
                    _chart(page, logs, stage, figure)


def _chart(
    page: Page, logs: Sequence[tuple[ComparedRun, Sequence[Mapping[str, float]]]], stage: str, figure: str
) -> None:
    lines = [line for run, rows in logs for line in log_lines(rows, figure, run.label, run.colour)]
    page.add_plot(lines, f"{stage}: {curve_label(figure)}")


def _chip(run: ComparedRun) -> Cell:
    return Cell(run.label, colour=run.colour)
