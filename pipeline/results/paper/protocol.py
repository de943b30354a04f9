"""Protocols of measured figures, beside those that the paper states."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import PurePosixPath

from motionloom.pipeline.evaluation.figures import Figure, FigureFile, decodings_of
from motionloom.pipeline.results.paper.schema import Column, DataSet, PaperTable
from motionloom.pipeline.store.run_state import StageRecord

Shown = tuple[Column, Figure]
"""A figure, and the column that it stands in."""
Difference = tuple[str, str, str | None]
"""One thing that was measured otherwise than in the paper, our value, and the paper's: None where it does not
say."""
_LENGTHS = {"free": "as the generator ends them", "recorded": "the recorded ones"}


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
        return "shards " + " + ".join(PurePosixPath(str(part.get("path"))).name for part in parts)
    return stage.kind


def is_named(data_set: str, data: str) -> bool:
    """Whether a run's data carry the name of a data set, spelling aside: "Motion-X" in "shards motionx"."""
    plain = [re.sub(r"[^a-z0-9]", "", text.lower()) for text in (data_set, data)]
    return plain[0] in plain[1]


def data_set_of(file: FigureFile, stage: StageRecord | None, known: Iterable[DataSet]) -> str:
    """The data set of a table that a run's data are: by name, else the first that has hands as they have."""
    data = data_of(stage)
    known = list(known)
    named = [one.name for one in known if is_named(one.name, data)]
    hands = file.of("reconstruction.mpjpe_hand") is not None
    return (named or [one.name for one in known if one.hands == hands] or [""])[0]


def differences(
    file: FigureFile, stage: StageRecord | None, table: PaperTable, shown: Sequence[Shown]
) -> list[Difference]:
    """Differences of the shown figures from the paper's protocol, and facts that it does not state."""
    paper = table.measured
    data = data_of(stage)
    # What, our value, the paper's, in the order in which they are told; unset ones of ours are left out.
    told: list[tuple[str, object, object]] = []
    if not any(is_named(name.split(" for ")[0], data) for name in paper.data.split(", ")):
        told.append(("data", data, paper.data))
    for column, figure in shown:
        facts = figure.protocol
        told += [
            ("split", facts.get("split"), paper.split),
            ("clips", facts.get("clips"), paper.clips),
            ("songs", facts.get("songs"), None),
        ]
        if "judge" in facts and file.kind == "evaluate":
            judges = file.about.get("judges", {})
            # The judge's role is a part of the figure's name.
            judge = next((judges[part]["stage"] for part in figure.name.split(".") if part in judges), None)
            told.append(("judged by", judge and f"stage {judge} of its own run", paper.evaluator))
        told.append(("lengths", _LENGTHS.get(str(facts.get("lengths"))), None))
        if column.candidates is not None:
            what = f"candidates of {column.group or column.name}"
            told.append((what, facts.get("candidates"), column.candidates))
        told += [
            ("repeats", _repeats(figure), paper.repeats),
            ("sampling", _sampling(figure), paper.sampling),
        ]
    out: dict[tuple[str, str], Difference] = {}
    for what, ours, theirs in told:
        if ours is not None and ours != theirs:
            out.setdefault((what, str(ours)), (what, str(ours), None if theirs is None else str(theirs)))
    return list(out.values())


def _repeats(figure: Figure) -> str | None:
    """Number of draws of motion, as the papers state it."""
    repeats = figure.protocol.get("repeats")
    decodings = decodings_of(figure.protocol)
    if repeats is None or decodings == 1:
        return None if repeats is None else str(repeats)
    return f"{repeats} of tokens, {decodings} of motion for each"


def _sampling(figure: Figure) -> str | None:
    """Settings of sampling, in one line."""
    facts = [(key.removeprefix("sampling."), value) for key, value in figure.protocol.items()
             if key.startswith("sampling.") and value is not None]  # fmt: skip
    return ", ".join(f"{key} {value}" for key, value in facts) or None
