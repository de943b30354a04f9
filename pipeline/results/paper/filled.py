"""A filled table, as Markdown and for terminals, and the notes below it: what differs from the paper's
protocol, and which rows are missing and why.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath
from typing import Literal, TypeVar

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from motionloom.pipeline.evaluation.figures import Figure, decodings_of
from motionloom.pipeline.results.paper.evaluations import Evaluation
from motionloom.pipeline.results.paper.schema import Column, DataSet, PaperTable, Printed
from motionloom.pipeline.store.run_state import StageRecord

T = TypeVar("T")

Source = Literal["paper", "ours", "missing", "reference"]
"""The paper's row; a model of ours; no model of ours; a reference baseline."""

_WHO = {"paper": "paper", "ours": "ours", "missing": "ours", "reference": "no model"}
_PAPERS = {"humantomato": "HumanTOMATO", "ude": "UDE"}
_ARROWS = {"lower": " ↓", "higher": " ↑", None: ""}
_LONG = 40
"""A longer description of the paper's protocol is not repeated with every difference."""


@dataclass(frozen=True)
class FilledRow:
    """A row of the paper, of a model of ours, or of a reference baseline."""

    source: Source
    method: str
    """The paper's row that it belongs to; empty for a baseline that belongs to all."""
    label: str
    """The paper's method, the stage of a run, or a reference baseline."""
    cells: tuple[Printed | None, ...]
    run: str = ""
    stages: tuple[str, ...] = ()
    """Stages of a model: one, or one for each setting."""
    evaluations: tuple[str, ...] = ()

    def marked(self, best: set[int]) -> FilledRow:
        """With the cells of these columns marked as the best."""
        cells = [cell and cell.model_copy(update={"best": at in best}) for at, cell in enumerate(self.cells)]
        return replace(self, cells=tuple(cells))


Difference = tuple[str, str, str | None]
"""One thing that was measured otherwise than in the paper, our value, and the paper's: None where it does not
say."""


@dataclass(frozen=True)
class FilledTable:
    """A paper's table with rows of runs."""

    name: str
    table: PaperTable
    rows: tuple[FilledRow, ...]
    differences: Mapping[str, Sequence[Difference]] = field(default_factory=dict)
    """By run and evaluation."""
    notes: tuple[str, ...] = ()

    @property
    def caption(self) -> str:
        paper, _, number = self.name.partition("/")
        title = f"{_PAPERS.get(paper, paper)} Table {number}" if number else self.name
        section = self.table.section
        section = section if section.startswith("appendix") else f"section {section}"
        return f"{title}: {self.table.title} ({section})"

    def lines_below(self) -> Iterator[str]:
        """Notes, then what was measured otherwise, one line for each evaluation."""
        yield from self.notes
        if alone := [_heading(column, arrow=False) for column in self.table.columns if not column.printed]:
            yield f"{', '.join(alone)}: not in the paper, a figure of ours alone."
        protocol = self.table.measured.dump().values()
        for evaluation, differences in self.differences.items():
            parts = []
            for what, ours, paper in differences:
                theirs = "the paper does not say" if paper is None else f"paper: {paper}"
                if paper is not None and len(paper) > _LONG and paper in protocol:
                    theirs = "paper: see above"
                parts.append(f"{what} {ours} ({theirs})")
            yield f"{evaluation}: {'; '.join(parts)}"

    def markdown(self) -> str:
        """A pipe table, the best figures bold, and what is to be known as a list below."""
        names = [_plain(_heading(column)) for column in self.table.columns]
        rows = [["", "", *names], ["---", "---", *("---:" for _ in names)]]
        for row in self.rows:
            cells = [_marked(cell, "**", "**") for cell in row.cells]
            rows.append([_plain(row.label), _WHO[row.source], *cells])
        body = [f"| {' | '.join(row)} |" for row in rows]
        below = [f"- {_plain(line)}" for line in self.lines_below()]
        return "\n".join([f"**{_plain(self.caption)}**", "", *body, "", *below, ""])

    def print(self, console: Console) -> None:
        """The table on a console: the best figures with a star, ours below the paper's."""
        grid = Table(title=escape(self.caption), title_justify="left", box=SIMPLE_HEAD)
        grid.add_column("", overflow="fold")
        for column in self.table.columns:
            grid.add_column(escape(_heading(column, "\n")), justify="right", overflow="fold")
        for row in self.rows:
            indent = "" if row.source in ("paper", "reference") else "  "
            cells = [escape(_marked(cell, "", "*")) for cell in row.cells]
            style = "dim" if row.source == "reference" else None
            grid.add_row(escape(indent + row.label), *cells, style=style)
        console.print(grid)
        for line in self.lines_below():
            console.print(f"- {escape(line)}")


def _heading(column: Column, between: str = " ", *, arrow: bool = True) -> str:
    """A column's group and name with its unit and the direction of better."""
    group = f"{column.group}{between}" if column.group else ""
    unit = f" ({column.unit})" if column.unit else ""
    return f"{group}{column.name}{unit}{_ARROWS[column.better] if arrow else ''}"


def _marked(cell: Printed | None, before: str, behind: str) -> str:
    if cell is None:
        return ""
    return f"{before}{cell.text}{behind}" if cell.best else cell.text


def _plain(text: str) -> str:
    """Text that Markdown shows as it is, also in a cell."""
    return re.sub(r"([\\|*<`\[])", r"\\\1", text.replace("\n", " "))


# Notes.


def notes_of(
    table: PaperTable,
    rows: Sequence[FilledRow],
    settings: Sequence[str],
    remarks: Sequence[str],
    *,
    with_runs: bool,
) -> tuple[str, ...]:
    """Sentences, most important first."""
    measured, out = table.measured, []
    facts = [f"data {measured.data}"]
    facts += [f"split {measured.split}"] if measured.split else []
    facts += [f"judged by {measured.evaluator}"] if measured.evaluator else []
    facts += [f"repeats {measured.repeats}"] if measured.repeats else []
    facts += [f"± is {measured.spread}"] if measured.spread else []
    out.append(f"The paper's numbers: {'; '.join(facts)}." + (f" {measured.note}" if measured.note else ""))
    out += [f"{row.method}: {row.note}." for row in table.rows if row.note]
    if not with_runs:  # what follows is about figures of ours
        return tuple(out)
    out.append("The paper's numbers are never ranked with ours: they were measured otherwise, as listed.")
    if any(cell and cell.best for row in rows for cell in row.cells):
        out.append("Marked as best: among models of ours that were measured alike, whatever their intervals.")
    if any(cell and cell.spread for row in rows if row.source != "paper" for cell in row.cells):
        out.append(
            "± of ours is half of the 95 % interval: over clips, of figures of whole sets over repeats."
        )
    columns = table.columns
    for differs, sharing in _shared(columns, lambda column: column.differs):
        out.append(f"{_titles(sharing)}: {differs}.")
    for why, sharing in _shared(columns, lambda column: column.why):
        out.append(f"No figure of ours for {_titles(sharing)}: {why}.")
    for why, methods in _shared(table.rows, lambda row: row.why):
        out.append(f"No model of ours for {', '.join(row.method for row in methods)}: {why}.")
    missing = [row.method for row in rows if row.source == "missing"]
    absent = [row.method for row in table.rows if row.ours is not None and row.method in missing]
    if absent:
        out.append(f"Not in these runs: {', '.join(dict.fromkeys(absent))}.")
    out += [f"{text}." for text in remarks]
    out += [f"Another setting than the paper's: {text}." for text in settings]
    return tuple(out)


def _shared(things: Iterable[T], text: Callable[[T], str]) -> list[tuple[str, list[T]]]:
    """(text, the things that share it), in order; empty texts left out."""
    groups: dict[str, list[T]] = defaultdict(list)
    for thing in things:
        if text(thing):
            groups[text(thing)].append(thing)
    return list(groups.items())


def _titles(columns: Iterable[Column]) -> str:
    """Names of columns, the group's once: "R-Precision (32) Top1, Top2"."""
    out, group = [], ""
    for column in columns:
        out.append(column.name if column.group == group else column.title)
        group = column.group
    return ", ".join(out)


def data_of(stage: StageRecord | None) -> str:
    """A run's data in a few words: the source or the shards' folders, and how many clips are made."""
    if stage is None:
        return "unknown"
    if stage.kind == "mix":
        return " + ".join(data_of(one) for one in stage.inputs.values())
    if stage.kind == "synth":
        return f"synthetic clips ({stage.config.get('clips')})"
    if stage.kind == "shards":
        mixed = stage.config.get("mix")
        parts = mixed if isinstance(mixed, list) and mixed else [{"path": stage.config.get("path")}]
        names = [PurePosixPath(str(part.get("path"))).name for part in parts]
        return "shards " + " + ".join(names)
    return stage.kind


def is_named(data_set: str, data: str) -> bool:
    """Whether a run's data carry the name of a data set, spelling aside: "Motion-X" in "shards motionx"."""
    plain = [re.sub(r"[^a-z0-9]", "", text.lower()) for text in (data_set, data)]
    return plain[0] in plain[1]


def data_set_of(evaluation: Evaluation, known: Iterable[DataSet]) -> str:
    """The data set of a table that a run's data are: by name, else the first that has hands as they have."""
    data, known = data_of(evaluation.data), list(known)
    named = [one.name for one in known if is_named(one.name, data)]
    hands = evaluation.figure("reconstruction.mpjpe_hand") is not None
    alike = [one.name for one in known if one.hands == hands]
    return (named or alike or [""])[0]


_LENGTHS = {"free": "as the generator ends them", "recorded": "the recorded ones"}


def differences(
    evaluation: Evaluation, table: PaperTable, used: Sequence[tuple[Column, Figure]]
) -> list[Difference]:
    """Differences of the shown figures from the paper's protocol, and facts that it does not state."""
    paper = table.measured
    out: dict[tuple[str, str], Difference] = {}

    def add(what: str, ours: object, theirs: object) -> None:
        if ours is not None and ours != theirs:
            stated = None if theirs is None else str(theirs)
            out.setdefault((what, str(ours)), (what, str(ours), stated))

    data = data_of(evaluation.data)
    if not any(is_named(name.split(" for ")[0], data) for name in paper.data.split(", ")):
        add("data", data, paper.data)
    for column, figure in used:
        facts = figure.protocol
        add("split", facts.get("split"), paper.split)
        add("clips", facts.get("clips"), paper.clips)
        add("songs", facts.get("songs"), None)
        if "judge" in facts and evaluation.measure == "evaluate":
            judges = evaluation.file.about.get("judges", {})
            # The judge's role is a part of the figure's name.
            stage = next((judges[part]["stage"] for part in figure.name.split(".") if part in judges), None)
            add("judged by", stage and f"stage {stage} of its own run", paper.evaluator)
        add("lengths", _LENGTHS.get(str(facts.get("lengths"))), None)
        if column.candidates is not None:
            what = f"candidates of {column.group or column.name}"
            add(what, facts.get("candidates"), column.candidates)
        add("repeats", _repeats(figure), paper.repeats)
        add("sampling", _sampling(figure), paper.sampling)
    return list(out.values())


def _repeats(figure: Figure) -> str | None:
    """Number of draws of motion, as the papers state it."""
    repeats, decodings = figure.protocol.get("repeats"), decodings_of(figure.protocol)
    if repeats is None or decodings == 1:
        return None if repeats is None else str(repeats)
    return f"{repeats} of tokens, {decodings} of motion for each"


def _sampling(figure: Figure) -> str | None:
    """Settings of sampling, in one line."""
    facts = {
        key.removeprefix("sampling."): v for key, v in figure.protocol.items() if key.startswith("sampling.")
    }
    return ", ".join(f"{key} {value}" for key, value in facts.items() if value is not None) or None
