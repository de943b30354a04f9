"""The runs that are compared: their names, settings that differ, and their figures side by side: which is
best where, and the reference baselines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from motionloom.datasets.schema import UserError
from motionloom.pipeline.evaluation.figures import (
    FILE_NAME,
    MODEL,
    Figure,
    FigureFile,
    columns_of,
    of_group,
    rows_of,
    say_difference,
)
from motionloom.pipeline.store.run_state import RunState, run_state
from motionloom.pipeline.store.training_log import read_training_log
from motionloom.pipeline.store.yaml import flatten

MOST = 8
"""Runs on one page: as many as there are colours."""


@dataclass(frozen=True)
class ComparedRun:
    """One of the runs that are compared."""

    label: str
    colour: int
    state: RunState

    @cached_property
    def logs(self) -> dict[str, list[dict[str, float]]]:
        """Rows of the training log of each stage that has one."""
        rows = {stage.name: read_training_log(stage.folder) for stage in self.state.stages}
        return {name: log for name, log in rows.items() if log}

    @cached_property
    def files(self) -> dict[str, Path]:
        """Files of figures of the run's finished stages."""
        paths = {stage.name: stage.folder / FILE_NAME for stage in self.state.stages if stage.usable}
        return {name: path for name, path in paths.items() if path.is_file()}

    @cached_property
    def evaluations(self) -> dict[str, FigureFile]:
        return {name: FigureFile.read(path) for name, path in self.files.items()}


def open_runs(folders: Sequence[Path]) -> list[ComparedRun]:
    """Read the runs; a `UserError` says what is none, or what cannot be compared."""
    if len(folders) < 2:
        raise UserError("name two runs or more, like: motionloom compare runs/first runs/second")
    if len(folders) > MOST:
        raise UserError(f"{len(folders)} runs: one page compares at most {MOST}; leave some out")
    places = [folder.resolve() for folder in folders]
    for folder, place in zip(folders, places, strict=True):
        if places.count(place) > 1:
            raise UserError(f"{folder}: is named twice; compare it with another run")
    names = run_labels(places)
    return [
        ComparedRun(label, number, run_state(folder))
        for number, (label, folder) in enumerate(zip(names, folders, strict=True))
    ]


def run_labels(places: Sequence[Path]) -> list[str]:
    """The last names of the folders, and as many of those above as tell them apart."""
    for depth in range(1, max((len(place.parts) for place in places), default=0) + 1):
        names = ["/".join(place.parts[-depth:]) for place in places]
        if len(set(names)) == len(names):
            return names
    return [str(place) for place in places]


# Settings in which runs differ, stage by stage.


ABSENT = "(absent)"
"""Stands for a setting that a run does not have."""


@dataclass(frozen=True)
class StageDifferences:
    """Settings of one stage that differ between runs; the stage "" is the recipe itself."""

    stage: str
    missing: tuple[str, ...]
    """Runs whose recipe has no such stage."""
    differences: Mapping[str, tuple[object, ...]]
    """Setting -> its value in each run, in the runs' order; `ABSENT` where a run does not have it."""


def stage_names(runs: Sequence[ComparedRun]) -> list[str]:
    """Stages of all runs, in the order of the first that has them."""
    return list(dict.fromkeys(stage.name for run in runs for stage in run.state.stages))


def setting_differences(runs: Sequence[ComparedRun]) -> list[StageDifferences]:
    """Differences of the recipes, then of each stage; stages that are equal in all runs are left out.

    A finished stage has the settings that made it, which its recipe may have changed since.
    """
    recipes = [
        {
            "recipe": run.state.recipe,
            "seed": run.state.seed,
            "data_seed": run.state.data_seed,
            **flatten({"hardware": run.state.hardware}),
        }
        for run in runs
    ]
    out = [StageDifferences("", (), _differences(recipes))]
    for name in stage_names(runs):
        stages = [run.state.stage(name) for run in runs]
        missing = tuple(run.label for run, stage in zip(runs, stages, strict=True) if stage is None)
        settings = [
            None if s is None else {"kind": s.kind, **flatten({"inputs": s.inputs}), **flatten(s.settings)}
            for s in stages
        ]
        out.append(StageDifferences(name, missing, _differences(settings)))
    return [stage for stage in out if stage.missing or stage.differences]


def _differences(each: Sequence[Mapping[str, object] | None]) -> dict[str, tuple[object, ...]]:
    """Keys whose values are not equal in all of `each` that are there."""
    present = [settings for settings in each if settings is not None]
    out = {}
    for key in dict.fromkeys(key for settings in present for key in settings):
        values = [settings.get(key, ABSENT) for settings in present]
        # Python takes 1 and true for equal.
        if any(
            value != values[0] or isinstance(value, bool) != isinstance(values[0], bool) for value in values
        ):
            out[key] = tuple(ABSENT if settings is None else settings.get(key, ABSENT) for settings in each)
    return out


# Figures of all runs, table by table.

Row = Mapping[str, Figure]
"""The figures of a row by name."""


@dataclass(frozen=True)
class RunRow:
    """The figures of one run."""

    run: ComparedRun
    figures: Row
    best: Mapping[str, bool]
    """Columns in which no run measured alike is better: whether the intervals are apart."""
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
    """One row for each reference baseline; where runs have other values of it, one for each value."""
    found: dict[str, dict[object, tuple[Row, list[str]]]] = {}
    for label, own in rows.items():
        for title, row in own.items():
            if title != MODEL:
                values = frozenset((name, figure.value, figure.interval) for name, figure in row.items())
                found.setdefault(title, {}).setdefault(values, (row, []))[1].append(label)
    return [
        ReferenceRow(title, row, () if len(each) == 1 else tuple(labels))
        for title, each in found.items()
        for row, labels in each.values()
    ]
