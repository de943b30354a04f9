"""Notes below a table: differences from the paper's protocol, and rows that are missing and why."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import PurePosixPath
from typing import TypeVar

from motionloom.pipeline.evaluation.figures import Figure, decodings_of
from motionloom.pipeline.results.paper.evaluations import Evaluation
from motionloom.pipeline.results.paper.filled import Difference, FilledRow
from motionloom.pipeline.results.paper.schema import Column, DataSet, PaperTable
from motionloom.pipeline.store.run_state import StageRecord

T = TypeVar("T")


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
    if not with_runs:
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
    evaluation: Evaluation, run: str, table: PaperTable, used: Sequence[tuple[Column, Figure]]
) -> list[Difference]:
    """Differences of the shown figures from the paper's protocol, and facts that it does not state."""
    paper = table.measured
    out: dict[tuple[str, str], Difference] = {}

    def add(what: str, ours: object, theirs: object) -> None:
        if ours is not None and ours != theirs:
            stated = None if theirs is None else str(theirs)
            out.setdefault((what, str(ours)), Difference(run, evaluation.name, what, str(ours), stated))

    data = data_of(evaluation.data)
    if not any(is_named(name.split(" for ")[0], data) for name in paper.data.split(", ")):
        add("data", data, paper.data)
    for column, figure in used:
        facts = figure.protocol
        add("split", facts.get("split"), paper.split)
        add("clips", facts.get("clips"), paper.clips)
        add("songs", facts.get("songs"), None)
        if "judge" in facts and evaluation.measure == "evaluate":
            stage = _judge(evaluation, figure)
            add("judged by", stage and f"stage {stage} of its own run", paper.evaluator)
        add("lengths", _LENGTHS.get(str(facts.get("lengths"))), None)
        if column.candidates is not None:
            what = f"candidates of {column.group or column.name}"
            add(what, facts.get("candidates"), column.candidates)
        add("repeats", _repeats(figure), paper.repeats)
        add("sampling", _sampling(figure), paper.sampling)
    return list(out.values())


def _judge(evaluation: Evaluation, figure: Figure) -> str | None:
    """The stage that a figure is judged by: its role is a part of the figure's name."""
    judges = evaluation.file.about.get("judges", {})
    return next((str(judges[part]["stage"]) for part in figure.name.split(".") if part in judges), None)


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
