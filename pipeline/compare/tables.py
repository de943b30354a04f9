"""Figures of all runs side by side: which is best where, and what they are compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from motionloom.pipeline.compare.measures import SUBJECT, TABLES, Figure, Measure, Row, TableSpec
from motionloom.pipeline.compare.protocols import groups, protocol_of, say_difference
from motionloom.pipeline.compare.runs import ComparedRun


@dataclass(frozen=True)
class RunRow:
    """The figures of one run."""

    run: ComparedRun
    figures: Row
    best: Mapping[str, bool]
    """Columns in which no run measured alike is better: whether the intervals leave no doubt of it."""
    protocol: int
    """Runs of one number were measured alike."""


@dataclass(frozen=True)
class ReferenceRow:
    """What the runs' figures are compared with; never ranked."""

    title: str
    figures: Row
    runs: tuple[str, ...]
    """The runs whose reference it is; empty where it is everybody's."""


@dataclass(frozen=True)
class ComparedTable:
    """One table."""

    title: str
    stage: str
    columns: tuple[Measure, ...]
    """Those that some row has."""
    rows: tuple[RunRow, ...]
    references: tuple[ReferenceRow, ...]
    difference: str
    """How protocols differ, in one sentence; empty where all were measured alike."""
    missing: tuple[str, ...]
    """Runs without these figures."""


def compared_tables(runs: Sequence[ComparedRun]) -> list[ComparedTable]:
    """All tables that a run has figures for."""
    stages = dict.fromkeys((file.stage, file.kind) for run in runs for file in run.evaluations.values())
    out = []
    for stage, kind in stages:
        for spec in TABLES:
            table = _table(spec, stage, runs) if spec.kind == kind else None
            if table is not None:
                out.append(table)
    return out


def _table(spec: TableSpec, stage: str, runs: Sequence[ComparedRun]) -> ComparedTable | None:
    found: dict[str, dict[str, Row]] = {}
    # What is not ranked, such as bits a second, makes no table beside figures that are.
    telling = [column for column in spec.columns if column.better] or spec.columns
    for run in runs:
        file = run.evaluations.get(stage)
        rows = {} if file is None or file.kind != spec.kind else spec.rows(file.figures)
        if any(column.title in rows.get(SUBJECT, {}) for column in telling):
            found[run.label] = rows
    if not found:
        return None
    protocols = {
        run.label: protocol_of(run.evaluations[stage], spec.protocol) for run in runs if run.label in found
    }
    numbers = {label: number for number, labels in enumerate(groups(protocols)) for label in labels}
    subjects = {label: rows[SUBJECT] for label, rows in found.items()}
    best = _best(spec.columns, subjects, numbers)
    there = {title for rows in found.values() for row in rows.values() for title in row}
    return ComparedTable(
        title=spec.title,
        stage=stage,
        columns=tuple(column for column in spec.columns if column.title in there),
        rows=tuple(
            RunRow(run, subjects[run.label], best[run.label], numbers[run.label])
            for run in runs
            if run.label in found
        ),
        references=tuple(_references(spec, found)),
        difference=say_difference(protocols) if len(found) > 1 else "",
        missing=tuple(run.label for run in runs if run.label not in found),
    )


def _best(
    columns: Sequence[Measure], rows: Mapping[str, Row], numbers: Mapping[str, int]
) -> dict[str, dict[str, bool]]:
    """Of each run the columns in which it is the best of those measured alike, and whether that is sure."""
    out: dict[str, dict[str, bool]] = {label: {} for label in rows}
    for column in columns:
        for number in set(numbers.values()):
            alike = {
                label: row[column.title]
                for label, row in rows.items()
                if numbers[label] == number and column.title in row
            }
            winner = _winner(alike, column.better)
            if winner is not None:
                out[winner[0]][column.title] = winner[1]
    return out


def _winner(figures: Mapping[str, Figure], better: str) -> tuple[str, bool] | None:
    """The best of two or more, and whether its interval is clear of the others'; None where two are equal."""
    if len(figures) < 2 or not better:
        return None
    sign = 1.0 if better == "lower" else -1.0
    order = sorted(figures.items(), key=lambda item: sign * item[1].mean)
    (label, first), (_, second) = order[:2]
    if first.mean == second.mean:
        return None
    sure = all(
        sign * (figure.mean - first.mean) > figure.half_width + first.half_width for _, figure in order[1:]
    )
    return label, sure


def _references(spec: TableSpec, found: Mapping[str, Mapping[str, Row]]) -> list[ReferenceRow]:
    """One row for each reference; where runs have other values of it, one for each value."""
    out = []
    for key, title in spec.references.items():
        values: list[tuple[Row, list[str]]] = []
        for label, rows in found.items():
            if key not in rows:
                continue
            same = next((labels for row, labels in values if row == rows[key]), None)
            if same is None:
                values.append((rows[key], [label]))
            else:
                same.append(label)
        for row, labels in values:
            out.append(ReferenceRow(title, row, () if len(values) == 1 else tuple(labels)))
    return out
