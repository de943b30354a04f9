"""How figures were measured: in what they differ from the paper's, and which of ours were measured alike."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import PurePosixPath

from motionloom.pipeline.published.conditions import value_at
from motionloom.pipeline.published.evaluations import Evaluation
from motionloom.pipeline.published.filled import Difference
from motionloom.pipeline.published.schema import Column, DataSet, PaperTable
from motionloom.pipeline.published.stages import RunStage

_RECONSTRUCTION = ("reconstruction_mm", "reconstruction_face", "reconstruction_latents")
_WITHOUT_JUDGE = ("agreement_with_caption", "positions", "movement")
_JUDGES = ("by_evaluator", "by_face_evaluator")
"""Groups of figures whose judge stands under the same name in the protocol."""


def data_of(stage: RunStage | None) -> str:
    """A run's data in a few words: the source or the shards' folders, and how many clips are made."""
    if stage is None:
        return "unknown"
    if stage.kind == "mix":
        return " + ".join(data_of(one) for one in stage.inputs.values())
    if stage.kind == "synth":
        return f"synthetic clips ({stage.config.get('clips')})"
    if stage.kind == "shards":
        parts = stage.config.get("mix") or [{"path": stage.config.get("path")}]
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
    hands = evaluation.value("reconstruction_mm.mpjpe_hand") is not None
    alike = [one.name for one in known if one.hands == hands]
    return (named or alike or [""])[0]


def measured_like(evaluation: Evaluation, figure: str) -> str:
    """Figures are measured alike when these words are equal: data, clips, what judges, among how many."""
    found, data = evaluation.figures, evaluation.data
    keys = ["split", "reconstructed_clips"]
    if evaluation.measure == "retrieval":
        keys = ["split", "clips_sha256", f"{figure.split('.')[0]}.size"]
    elif evaluation.measure == "evaluate_dances":
        keys = ["split", "clips", "songs", "feature_fps"]
    elif figure.startswith("reconstruction_latents"):
        judge = figure.split(".")[1]
        keys += [f"protocol.{'evaluator' if judge == 'tma' else f'by_{judge}'}.sha256"]
    elif not figure.startswith(_RECONSTRUCTION):
        keys = ["split", "clips", "protocol.lengths"]
        first = figure.split(".")[0]
        if first in _JUDGES:
            keys += [f"protocol.{first}.sha256", f"{first}.matching.size"]
        elif first not in _WITHOUT_JUDGE:
            keys += ["protocol.evaluator.sha256"]
        if figure.startswith("retrieval"):
            keys += ["retrieval.among" if "top-" in figure else "retrieval.size"]
    facts = {key: value_at(found, key, None) for key in keys}
    facts["threshold"] = evaluation.config.get("threshold")
    return json.dumps([evaluation.measure, data and data.fingerprint, facts], sort_keys=True)


def differences(evaluation: Evaluation, run: str, table: PaperTable) -> list[Difference]:
    """What was measured otherwise than in the paper, or is not said there, for the table's columns."""
    paper, columns = table.measured, [column for column in table.columns if column.of == evaluation.measure]
    out: list[Difference] = []

    def add(what: str, ours: object, theirs: object) -> None:
        if ours is not None and ours != theirs:
            said = None if theirs is None else str(theirs)
            out.append(Difference(run, evaluation.name, what, str(ours), said))

    data = data_of(evaluation.data)
    if not any(is_named(name.split(" for ")[0], data) for name in paper.data.split(", ")):
        add("data", data, paper.data)
    add("split", value_at(evaluation.figures, "split", None), paper.split)
    add("clips", _clips(evaluation, columns), paper.clips)
    if evaluation.measure == "evaluate" and not _reconstructs(columns):
        stage = value_at(evaluation.figures, "protocol.evaluator.stage", None)
        add("judged by", stage and f"its own stage {stage}", paper.evaluator)
        add("lengths", _lengths(evaluation), None)
    for what, ours, theirs in _candidates(evaluation, columns):
        add(what, ours, theirs)
    if not _reconstructs(columns):
        add("repeats", _repeats(evaluation), paper.repeats)
    return out


def _reconstructs(columns: list[Column]) -> bool:
    return all((column.figure or "reconstruction_mm").startswith(_RECONSTRUCTION) for column in columns)


def _clips(evaluation: Evaluation, columns: list[Column]) -> int | None:
    if evaluation.measure == "retrieval":
        sizes = [row["size"] for row in evaluation.figures.values() if isinstance(row, dict)]
        return max(sizes, default=None)
    key = "reconstructed_clips" if _reconstructs(columns) else "clips"
    found = value_at(evaluation.figures, key, None)
    return found if isinstance(found, int) else None


def _lengths(evaluation: Evaluation) -> str | None:
    found = value_at(evaluation.figures, "protocol.lengths", None)
    return {"free": "as the generator ends them", "recorded": "the recorded ones"}.get(str(found))


def _repeats(evaluation: Evaluation) -> str | None:
    key = "repeats" if evaluation.measure == "evaluate_dances" else "protocol.repeats"
    found = value_at(evaluation.figures, key, None)
    return None if found is None else str(found)


def _candidates(evaluation: Evaluation, columns: list[Column]) -> list[tuple[str, int, int]]:
    """(what, ours, the paper's), each once."""
    out: dict[tuple[str, int, int], None] = {}
    for column in columns:
        if column.candidates is None or column.figure is None:
            continue
        key = "retrieval.among" if "top-" in column.figure else "retrieval.size"
        if (first := column.figure.split(".")[0]) in _JUDGES:
            key = f"{first}.matching.size"
        ours = value_at(evaluation.figures, key, None)
        if isinstance(ours, int):
            out[(f"candidates of {column.group or column.name}", ours, column.candidates)] = None
    return list(out)
