"""The rows of runs in a table of a paper: which of their stages each row is, and what they measured."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from motionloom.pipeline.evaluation.figures import MODEL, RECORDED, ROWS, Figure, Protocol, say_difference
from motionloom.pipeline.results.paper.evaluations import Evaluation, evaluations_of
from motionloom.pipeline.results.paper.filled import (
    FilledRow,
    FilledTable,
    data_set_of,
    differences,
    notes_of,
)
from motionloom.pipeline.results.paper.schema import (
    Column,
    PaperTable,
    Printed,
    Row,
    config_fits,
    may_fill,
    value_at,
)
from motionloom.pipeline.store.run_state import StageRecord

_MISSING, _NO_MODEL = "missing in these runs", "missing: no model of ours"

_BASELINES = tuple(row for row in ROWS if row != MODEL)


def fill(name: str, table: PaperTable, runs: Sequence[Path] = ()) -> FilledTable:
    """The table with the rows of `runs`, each under the paper's row that it is; without any, the paper's."""
    return _Filling(name, table, runs).filled()


def _labels(runs: Sequence[Path]) -> dict[Path, str]:
    """Run -> the last name of its folder, and as many of those above as tell the runs apart."""
    places = [run.resolve() for run in runs]
    names = [str(place) for place in places]
    for depth in range(1, max((len(place.parts) for place in places), default=0) + 1):
        short = ["/".join(place.parts[-depth:]) for place in places]
        if len(set(short)) == len(short):
            names = short
            break
    return dict(zip(runs, names, strict=True))


class _Filling:
    """A table being filled in."""

    def __init__(self, name: str, table: PaperTable, runs: Sequence[Path]) -> None:
        self.name, self.table = name, table
        runs = list(dict.fromkeys(runs))
        self.evaluations = {run: evaluations_of(run, table.measures) for run in runs if table.measures}
        self.labels = _labels(runs)
        self.decimals = [self._decimals(at) for at in range(len(table.columns))]
        self.used: dict[tuple[Path, str], Evaluation] = {}
        self.compared: set[tuple[Path, str]] = set()
        """Evaluations whose models stand in the table."""
        self.shown: dict[tuple[Path, str], list[tuple[Column, Figure]]] = {}
        self.settings: dict[str, None] = {}
        self.remarks: dict[str, dict[str, None]] = defaultdict(dict)
        self.seen: set[tuple[object, ...]] = set()

    def filled(self) -> FilledTable:
        """The paper's rows, ours below each, and the reference baselines."""
        # Models first: baselines are shown of those evaluations whose models stand in the table.
        models = [self._models(row) for row in self.table.rows]
        self.compared = set(self.used)
        rows: list[FilledRow] = []
        for row, ours in zip(self.table.rows, models, strict=True):
            printed = iter(row.printed())
            cells = tuple(next(printed) if column.printed else None for column in self.table.columns)
            rows += [FilledRow("paper", row.method, row.method, cells), *ours]
            if row.recorded:
                rows += self._references({}, (RECORDED,))
            if row.values:
                rows += self._references(row.values, _BASELINES)
        if not any(row.values for row in self.table.rows):
            rows += self._references({}, _BASELINES)
        unlike = {
            f"{self.labels[run]} {name}": found
            for (run, name), evaluation in self.used.items()
            if (found := differences(evaluation, self.table, self.shown.get((run, name), [])))
        }
        marked = mark_best(rows, self.table.columns)
        remarks = [*self._unlike(), *(f"{', '.join(of)}: {note}" for note, of in self.remarks.items())]
        notes = notes_of(self.table, marked, list(self.settings), remarks, with_runs=bool(self.evaluations))
        return FilledTable(self.name, self.table, marked, unlike, notes)

    def _unlike(self) -> list[str]:
        """Sentences on figures of one column that were measured differently from each other."""
        columns: dict[str, dict[str, Protocol]] = {}
        for (run, name), figures in self.shown.items():
            for column, figure in figures:
                columns.setdefault(column.title, {})[f"{self.labels[run]} {name}"] = figure.protocol
        sentences = dict.fromkeys(say_difference(protocols) for protocols in columns.values())
        return [sentence.removesuffix(".") for sentence in sentences if sentence]

    def _decimals(self, at: int) -> int:
        """Decimals of our figures: as many as the paper prints in that column."""
        column = self.table.columns[at]
        if not column.printed:
            return 1 if column.unit == "mm" else 3
        place = sum(one.printed for one in self.table.columns[:at])
        cells = [row.printed()[place] for row in self.table.rows]
        return max((cell.decimals for cell in cells if cell is not None), default=3)

    def _models(self, row: Row) -> list[FilledRow]:
        """Our rows of one of the paper's; one that says so where there are none."""
        if row.recorded or not self.evaluations:
            return []
        ours = [one for run in self.evaluations for one in self._of_run(run, row)]
        label = _NO_MODEL if row.ours is None else _MISSING
        return ours or [FilledRow("missing", row.method, label, (None,) * len(self.table.columns))]

    def _of_run(self, run: Path, row: Row) -> list[FilledRow]:
        """One row for each model of a run, or for its set of models where the columns are settings."""
        if row.ours is None:
            return []
        role, conditions = row.ours.role, row.ours.conditions()
        fitting = [
            (evaluation, evaluation.about[role])
            for evaluation in self.evaluations[run]
            if role in evaluation.about
            and all(may_fill(match, evaluation.about.get(name)) for name, match in conditions.items())
        ]
        if any(column.where for column in self.table.columns):
            made = self._ours(run, row, fitting)
            return [made] if made.stages else []
        names = dict.fromkeys(model.name for _, model in fitting)
        return [self._ours(run, row, [pair for pair in fitting if pair[1].name == n], n) for n in names]

    def _ours(
        self, run: Path, row: Row, fitting: Sequence[tuple[Evaluation, StageRecord]], name: str = ""
    ) -> FilledRow:
        """A row of our models: in each column the figure of the first evaluation that has measured it."""
        assert row.ours is not None
        cells: list[Printed | None] = []
        models, evaluations = dict.fromkeys([name] if name else []), dict[str, None]()
        for at, column in enumerate(self.table.columns):
            cell = None
            for evaluation, model in fitting:
                figure = self._figure(column, evaluation, row.values)
                if figure is not None and config_fits(column.where, model.config):
                    models[model.name] = evaluations[evaluation.name] = None
                    self.used[run, evaluation.name] = evaluation
                    self._settings(run, model, {**row.ours.setting, **column.setting})
                    cell = self._cell(evaluation, figure, at)
                    break
            cells.append(cell)
        label = " ".join([self.labels[run], ", ".join(models)])
        return FilledRow(
            "ours", row.method, label, tuple(cells), self.labels[run], tuple(models), tuple(evaluations)
        )

    def _figure(
        self, column: Column, evaluation: Evaluation, values: Mapping[str, str], row: str = MODEL
    ) -> Figure | None:
        """The figure of a column in an evaluation; None where it measures another thing or other data."""
        if column.figure is None or evaluation.measure != column.of:
            return None
        if column.data and data_set_of(evaluation, self.table.data) != column.data:
            return None
        return evaluation.figure(column.figure.format(**values), row)

    def _settings(self, run: Path, model: StageRecord, paper: Mapping[str, object]) -> None:
        """Note where a model of ours has another setting than the paper's."""
        wrong = []
        for key, theirs in paper.items():
            ours = value_at(model.config, key, None)
            if ours != theirs:
                wrong.append(f"{key} {ours} (paper: {theirs})")
        if wrong:
            self.settings[f"{self.labels[run]} {model.name}: {', '.join(wrong)}"] = None

    def _cell(self, evaluation: Evaluation, figure: Figure, at: int) -> Printed:
        column, digits = self.table.columns[at], self.decimals[at]
        self.shown.setdefault((evaluation.run, evaluation.name), []).append((column, figure))
        if figure.note:
            self.remarks[figure.note][f"{column.title} of {self.labels[evaluation.run]}"] = None
        mean = figure.value * column.scale
        spread = None if figure.interval is None else figure.interval * column.scale
        text = f"{mean:.{digits}f}" + ("" if spread is None else f" ± {spread:.{digits}f}")
        return Printed(text=text, mean=mean, spread=spread, alike=figure.protocol_key)

    def _references(self, values: Mapping[str, str], titles: Iterable[str]) -> list[FilledRow]:
        """Reference baselines of the evaluations whose models stand in the table, or of all where no
        model does; equal ones once.
        """
        out = []
        for title in titles:
            for run, all_of_run in self.evaluations.items():
                for evaluation in all_of_run:
                    if self.compared and (run, evaluation.name) not in self.compared:
                        continue
                    row = self._reference(run, evaluation, title, values)
                    key = (title, tuple(cell and cell.text for cell in row.cells), *values.items())
                    if any(row.cells) and key not in self.seen:
                        self.seen.add(key)
                        self.used.setdefault((run, evaluation.name), evaluation)
                        out.append(row)
        return out

    def _reference(
        self, run: Path, evaluation: Evaluation, title: str, values: Mapping[str, str]
    ) -> FilledRow:
        figures = [self._figure(column, evaluation, values, title) for column in self.table.columns]
        cells = [f if f is None else self._cell(evaluation, f, at) for at, f in enumerate(figures)]
        label = f"{title} ({self.labels[run]} {evaluation.name})"
        return FilledRow("reference", "", label, tuple(cells), self.labels[run], (), (evaluation.name,))


# Which rows are shown, and which figures are the best of those measured alike.


def mark_best(rows: Sequence[FilledRow], columns: Sequence[Column]) -> tuple[FilledRow, ...]:
    """The rows with the best figures marked: of models of ours, two or more of them measured alike.

    The paper's rows, recorded motion and other reference baselines are never ranked. Equal figures
    are marked together; the figure as it is printed decides.
    """
    best: dict[int, set[int]] = defaultdict(set)
    for at, column in enumerate(columns):
        alike: dict[str, dict[int, float]] = defaultdict(dict)
        for number, row in enumerate(rows):
            cell = row.cells[at]
            if cell is not None and row.source == "ours":
                alike[cell.alike][number] = float(cell.text.split(" ")[0])
        for values in alike.values() if column.better else ():
            wanted = min(values.values()) if column.better == "lower" else max(values.values())
            for number, value in values.items():
                if value == wanted and len(set(values.values())) > 1:
                    best[number].add(at)
    return tuple(row.marked(best[number]) for number, row in enumerate(rows))
