"""The rows of runs in a table of a paper: which of their stages each row is, and what they measured."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.evaluation.figures import (
    DASH,
    FILE_NAME,
    MODEL,
    RECORDED,
    ROWS,
    Figure,
    FigureFile,
    Protocol,
    say_difference,
)
from motionloom.pipeline.results.paper.filled import Cell, FilledRow, FilledTable, mark_best, notes_of
from motionloom.pipeline.results.paper.protocol import Shown, data_set_of, differences
from motionloom.pipeline.results.paper.schema import Column, Measure, PaperTable, Row, config_fits, fits
from motionloom.pipeline.store.artifact import require_consistent
from motionloom.pipeline.store.run_state import StageRecord, finished_records
from motionloom.pipeline.store.yaml import flatten

_BASELINES = tuple(row for row in ROWS if row != MODEL)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A finished evaluation of a run, and the stages that it is about, by role (`schema.ROLES`)."""

    run: str
    """The run's name in the table."""
    name: str
    """Its stage, or the file of the command `retrieval`."""
    file: FigureFile
    about: Mapping[str, StageRecord]
    data: StageRecord | None

    @property
    def label(self) -> str:
        return f"{self.run} {self.name}"


def evaluations_of(run: Path, label: str, measures: Iterable[Measure]) -> list[Evaluation]:
    """All that a run has of `measures`, in the recipe's order; a `UserError` where it has none."""
    stages = finished_records(run)
    wanted = tuple(measures)
    out = list[Evaluation]()
    for stage in stages.values():
        if stage.kind in wanted and (stage.folder / FILE_NAME).is_file():
            require_consistent(run, [stage.name])
            file = FigureFile.read(stage.folder / FILE_NAME)
            about = {
                role: stage.inputs[role] for role in ("tokenizer", "face_tokenizer") if role in stage.inputs
            }
            makers = {one.name: one for role, one in stage.inputs.items() if role.startswith("generators.")}
            about |= {
                role: makers[name] for role, name in file.about.get("made_by", {}).items() if name in makers
            }
            out.append(Evaluation(label, stage.name, file, about, stage.inputs.get("data")))
    for path in sorted(run.glob("retrieval*.json")) if "retrieval" in wanted else ():
        file = FigureFile.read(path)
        judge = stages.get(str(file.about.get("stage")))
        if judge is None:
            raise UserError(f"{path}: not a record of motionloom retrieval on this run; run it again")
        if file.about.get("fingerprint") != judge.fingerprint:
            raise UserError(
                f"{path}: measured by another '{judge.name}' than is there now; measure again: "
                f"motionloom retrieval {run} --stage {judge.name}"
            )
        out.append(Evaluation(label, path.name, file, {"alignment": judge}, judge.inputs.get("data")))
    if not out:
        fix = f"finish a stage of kind {' or '.join(wanted)}: motionloom run {run / 'recipe.yaml'} -o {run}"
        if "retrieval" in wanted:
            fix = f"make one: motionloom retrieval {run}"
        raise UserError(f"{run}: no finished evaluation that this table takes figures of; {fix}")
    return out


def fill(name: str, table: PaperTable, runs: Sequence[Path] = ()) -> FilledTable:
    """The table with the rows of `runs`, each under the paper's row that it is; without any, the paper's."""
    return _Filling(table, list(dict.fromkeys(rows_of(runs)))).filled(name)


def rows_of(runs: Sequence[Path]) -> list[Path]:
    """The run folders; those within, where one is of a sweep."""
    return [
        row for run in runs for row in sorted(place.parent for place in run.glob("*=*/recipe.yaml")) or [run]
    ]


def _labels(runs: Sequence[Path]) -> list[str]:
    """The last names of the runs' folders, and as many of those above as tell the runs apart."""
    places = [run.resolve().parts for run in runs]
    for depth in range(1, max(map(len, places), default=1) + 1):
        names = ["/".join(place[-depth:]) for place in places]
        if len(set(names)) == len(names):
            break
    return names


class _Filling:
    """A table being filled in."""

    def __init__(self, table: PaperTable, runs: Sequence[Path]) -> None:
        self.table = table
        self.runs = [
            evaluations_of(run, label, table.measures)
            for run, label in zip(runs, _labels(runs), strict=True)
            if table.measures
        ]
        self.used: dict[Evaluation, None] = {}
        """Evaluations with a row of the table."""
        self.shown: dict[Evaluation, list[Shown]] = defaultdict(list)
        self.settings: dict[str, None] = {}
        self.remarks: dict[str, dict[str, None]] = defaultdict(dict)
        self.seen: set[tuple[object, ...]] = set()

    def filled(self, name: str) -> FilledTable:
        """The paper's rows, ours below each, and the reference baselines."""
        # Models first: baselines are shown of those evaluations whose models stand in the table, or of all.
        models = [self._models(row) for row in self.table.rows]
        every = [one for run in self.runs for one in run]
        compared = [one for one in every if one in self.used] or every
        rows: list[FilledRow] = []
        for row, ours in zip(self.table.rows, models, strict=True):
            printed = iter(row.printed())
            texts = [next(printed) if column.printed else "" for column in self.table.columns]
            cells = tuple(Cell(text) if text else None for text in texts)
            rows += [FilledRow("paper", row.method, row.method, cells), *ours]
            if row.recorded:
                rows += self._references(compared, {}, (RECORDED,))
            if row.values:
                rows += self._references(compared, row.values, _BASELINES)
        if not any(row.values for row in self.table.rows):
            rows += self._references(compared, {}, _BASELINES)
        unlike = {
            one.label: differences(one.file, one.data, self.table, self.shown[one]) for one in self.used
        }
        marked = mark_best(rows, self.table.columns)
        remarks = [*self._unlike(), *(f"{', '.join(of)}: {note}" for note, of in self.remarks.items())]
        notes = notes_of(self.table, marked, list(self.settings), remarks, with_runs=bool(self.runs))
        return FilledTable(name, self.table, marked, unlike, notes)

    def _unlike(self) -> list[str]:
        """Sentences on figures of one column that were measured differently from each other."""
        columns: dict[str, dict[str, Protocol]] = defaultdict(dict)
        for evaluation, figures in self.shown.items():
            for column, figure in figures:
                columns[column.title][evaluation.label] = figure.protocol
        sentences = dict.fromkeys(say_difference(protocols) for protocols in columns.values())
        return [sentence.removesuffix(".") for sentence in sentences if sentence]

    def _models(self, row: Row) -> list[FilledRow]:
        """Our rows of one of the paper's; one that says so where there are none."""
        if row.recorded or not self.runs:
            return []
        ours = [] if row.ours is None else [one for run in self.runs for one in self._of_run(run, row)]
        label = "missing: no model of ours" if row.ours is None else "missing in these runs"
        return ours or [FilledRow("missing", row.method, label, (None,) * len(self.table.columns))]

    def _of_run(self, run: Sequence[Evaluation], row: Row) -> list[FilledRow]:
        """One row for each model of a run, or for its set of models where the columns are settings."""
        assert row.ours is not None
        groups: dict[str, list[tuple[Evaluation, StageRecord]]] = defaultdict(list)
        settings = any(column.where for column in self.table.columns)
        for one in run:
            model = one.about.get(row.ours.role)
            conditions = row.ours.conditions()
            if model and all(fits(match, one.about.get(role)) for role, match in conditions.items()):
                groups["" if settings else model.name].append((one, model))
        rows = [self._ours(row, name, group) for name, group in groups.items()]
        return [made for made in rows if not settings or any(made.cells)]

    def _ours(self, row: Row, name: str, group: Sequence[tuple[Evaluation, StageRecord]]) -> FilledRow:
        """A row of our models: in each column the figure of the first evaluation that has measured it."""
        assert row.ours is not None
        cells = list[Cell | None]()
        models = dict.fromkeys([name] if name else [])
        for column in self.table.columns:
            cell = None
            for one, model in group:
                figure = self._figure(column, one, row.values, MODEL)
                if figure is not None and config_fits(column.where, model.config):
                    models[model.name] = self.used[one] = None
                    self._settings(f"{one.run} {model.name}", model, {**row.ours.setting, **column.setting})
                    cell = self._cell(one, column, figure)
                    break
            cells.append(cell)
        return FilledRow("ours", row.method, f"{group[0][0].run} {', '.join(models)}", tuple(cells))

    def _figure(self, column: Column, of: Evaluation, values: Mapping[str, str], row: str) -> Figure | None:
        """The figure of a column in an evaluation; None where it measures another thing or other data."""
        if column.figure is None or of.file.kind != column.of:
            return None
        if column.data and data_set_of(of.file, of.data, self.table.data) != column.data:
            return None
        return of.file.of(column.figure.format(**values), row)

    def _settings(self, label: str, model: StageRecord, paper: Mapping[str, object]) -> None:
        """Note where a model of ours has another setting than the paper's."""
        ours = flatten(model.config)
        wrong = [
            f"{k} {ours.get(k)} (paper: {theirs})" for k, theirs in paper.items() if ours.get(k) != theirs
        ]
        if wrong:
            self.settings[f"{label}: {', '.join(wrong)}"] = None

    def _cell(self, of: Evaluation, column: Column, figure: Figure) -> Cell:
        """A figure with as many decimals as the paper prints in that column."""
        digits = 1 if column.unit == "mm" else 3
        if column.printed:
            place = [one for one in self.table.columns if one.printed].index(column)
            texts = [text for row in self.table.rows if (text := row.printed()[place])]
            digits = max((len(text.split(" ")[0].partition(".")[2]) for text in texts), default=3)
        self.shown[of].append((column, figure))
        if figure.note:
            self.remarks[figure.note][f"{column.title} of {of.run}"] = None
        if figure.nothing:
            self.remarks[f"{DASH} {figure.nothing}"][f"{column.title} of {of.run}"] = None
            return Cell(DASH)
        numbers = [figure.value] if figure.interval is None else [figure.value, figure.interval]
        text, *spread = [f"{number * column.scale:.{digits}f}" for number in (*numbers, *figure.pair)]
        if figure.pair:
            text = f"{text} ({', '.join(spread)})"
        elif spread:
            text = f"{text} ± {spread[0]}"
        return Cell(text, figure.protocol_key)

    def _references(
        self, evaluations: Sequence[Evaluation], values: Mapping[str, str], titles: Iterable[str]
    ) -> list[FilledRow]:
        """Reference baselines of evaluations; equal ones once."""
        out = []
        for title in titles:
            for one in evaluations:
                figures = [self._figure(column, one, values, title) for column in self.table.columns]
                pairs = zip(self.table.columns, figures, strict=True)
                cells = tuple(self._cell(one, column, found) if found else None for column, found in pairs)
                key = (title, *(cell.text if cell else "" for cell in cells), *values.items())
                if any(cells) and key not in self.seen:
                    self.seen.add(key)
                    self.used.setdefault(one)
                    out.append(FilledRow("reference", "", f"{title} ({one.label})", cells))
        return out
