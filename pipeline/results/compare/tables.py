"""Figures of all runs side by side: which is best where, and what they are compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from motionloom.pipeline.evaluation.figures import (
    MODEL,
    Figure,
    columns_of,
    of_group,
    rows_of,
    say_difference,
)
from motionloom.pipeline.results.compare.runs import ComparedRun

Row = Mapping[str, Figure]
"""The figures of a row by name."""


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
    """A reference baseline beside the runs; never ranked."""

    title: str
    figures: Row
    runs: tuple[str, ...]
    """The runs whose reference it is; empty where it is everybody's."""


@dataclass(frozen=True)
class ComparedTable:
    """A group of figures of all runs."""

    title: str
    stage: str
    columns: tuple[Figure, ...]
    """A figure of each: its name, title, unit and which direction is better."""
    rows: tuple[RunRow, ...]
    references: tuple[ReferenceRow, ...]
    difference: str
    """A sentence on how protocols differ; empty where all were measured alike."""
    missing: tuple[str, ...]
    """Runs without these figures."""


def compared_tables(runs: Sequence[ComparedRun]) -> list[ComparedTable]:
    """All tables that a run has figures for."""
    out = []
    for stage in dict.fromkeys(name for run in runs for name in run.evaluations):
        groups_of = {
            run.label: of_group(run.evaluations[stage].figures) for run in runs if stage in run.evaluations
        }
        for group in dict.fromkeys(group for groups in groups_of.values() for group in groups):
            figures = {label: groups[group] for label, groups in groups_of.items() if group in groups}
            table = _table(group, stage, runs, figures)
            if table is not None:
                out.append(table)
    return out


def _table(
    group: str, stage: str, runs: Sequence[ComparedRun], by_label: Mapping[str, Sequence[Figure]]
) -> ComparedTable | None:
    columns = columns_of(figure for figures in by_label.values() for figure in figures)
    # What is not ranked, such as bits a second, makes no table beside figures that are.
    telling = [name for name, column in columns.items() if column.better] or list(columns)
    rows = {label: rows_of(figures) for label, figures in by_label.items()}
    rows = {label: own for label, own in rows.items() if any(name in own.get(MODEL, {}) for name in telling)}
    if not rows:
        return None
    # All figures of a group have one protocol.
    protocols = {label: by_label[label][0].protocol for label in rows}
    keys = {label: by_label[label][0].protocol_key for label in rows}
    # Protocols are numbered as they come; runs of one number are ranked with each other.
    order = list(dict.fromkeys(keys.values()))
    numbers = {label: order.index(key) for label, key in keys.items()}
    subjects = {label: own[MODEL] for label, own in rows.items()}
    best = _best(subjects, numbers)
    measured = [run for run in runs if run.label in rows]
    return ComparedTable(
        title=group,
        stage=stage,
        columns=tuple(columns.values()),
        rows=tuple(RunRow(run, subjects[run.label], best[run.label], numbers[run.label]) for run in measured),
        references=tuple(_references(rows)),
        difference=say_difference(protocols),
        missing=tuple(run.label for run in runs if run.label not in rows),
    )


def _best(rows: Mapping[str, Row], protocols: Mapping[str, int]) -> dict[str, dict[str, bool]]:
    """Run -> columns in which it is the best of those measured alike -> whether that is significant."""
    out: dict[str, dict[str, bool]] = {label: {} for label in rows}
    for name in dict.fromkeys(name for row in rows.values() for name in row):
        for protocol in set(protocols.values()):
            alike = {
                label: row[name]
                for label, row in rows.items()
                if name in row and protocols[label] == protocol
            }
            winner = _winner(alike)
            if winner is not None:
                out[winner[0]][name] = winner[1]
    return out


def _winner(figures: Mapping[str, Figure]) -> tuple[str, bool] | None:
    """The best of two or more, and whether its interval is clear of the others'; None where two are equal."""
    better = next((one.better for one in figures.values()), "")
    if len(figures) < 2 or not better:
        return None
    sign = 1.0 if better == "lower" else -1.0
    order = sorted(figures.items(), key=lambda item: sign * item[1].value)
    (label, first), (_, second) = order[:2]
    if first.value == second.value:
        return None
    # Two 95 % intervals that do not overlap: stricter than a test of the difference **[ours]**.
    sure = all(
        sign * (other.value - first.value) > (other.interval or 0.0) + (first.interval or 0.0)
        for _, other in order[1:]
    )
    return label, sure


def _references(rows: Mapping[str, Mapping[str, Row]]) -> list[ReferenceRow]:
    """One row for each answer without a model; where runs have other values of it, one for each value."""
    out = []
    for title in dict.fromkeys(title for own in rows.values() for title in own if title != MODEL):
        values: list[tuple[Row, list[str]]] = []
        for label, own in rows.items():
            if title not in own:
                continue
            same = next((labels for row, labels in values if _equal(row, own[title])), None)
            if same is None:
                values.append((own[title], [label]))
            else:
                same.append(label)
        for row, labels in values:
            out.append(ReferenceRow(title, row, () if len(values) == 1 else tuple(labels)))
    return out


def _equal(one: Row, other: Row) -> bool:
    return {k: (f.value, f.interval) for k, f in one.items()} == {
        k: (f.value, f.interval) for k, f in other.items()
    }
