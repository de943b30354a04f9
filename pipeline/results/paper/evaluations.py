"""The finished evaluations of a run: their figures, and the stages that each is about."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from motionloom.datasets.schema import UserError
from motionloom.pipeline.evaluation.figures import FILE_NAME, MODEL, Figure, FigureFile
from motionloom.pipeline.results.paper.schema import Measure
from motionloom.pipeline.store.artifact import require_consistent
from motionloom.pipeline.store.run_state import StageRecord, finished_records


@dataclass(frozen=True)
class Evaluation:
    """Figures of one evaluation, and the stages that it is about, by role (`schema.ROLES`)."""

    run: Path
    name: str
    """Its stage, or the file of the command `retrieval`."""
    file: FigureFile
    about: Mapping[str, StageRecord]
    data: StageRecord | None

    @property
    def measure(self) -> str:
        return self.file.kind

    def figure(self, name: str, row: str = MODEL) -> Figure | None:
        """One figure; None where it was not measured."""
        return self.file.of(name, row)


def evaluations_of(run: Path, measures: Iterable[Measure]) -> list[Evaluation]:
    """All that a run has of `measures`, in the recipe's order; a `UserError` where it has none."""
    stages, wanted = finished_records(run), tuple(measures)
    evaluations = [
        _staged(run, stage)
        for stage in stages.values()
        if stage.kind in wanted and (stage.folder / FILE_NAME).is_file()
    ]
    if "retrieval" in wanted:
        evaluations += [_retrieval(path, run, stages) for path in sorted(run.glob("retrieval*.json"))]
    if not evaluations:
        fix = f"finish a stage of kind {' or '.join(wanted)}: motionloom run {run / 'recipe.yaml'} -o {run}"
        if "retrieval" in wanted:
            fix = f"make one: motionloom retrieval {run}"
        raise UserError(f"{run}: no finished evaluation that this table takes figures of; {fix}")
    return evaluations


def _staged(run: Path, stage: StageRecord) -> Evaluation:
    """The evaluation that a stage wrote."""
    require_consistent(run, [stage.name])
    file = FigureFile.read(stage.folder / FILE_NAME)
    about = {role: stage.inputs[role] for role in ("tokenizer", "face_tokenizer") if role in stage.inputs}
    makers = {one.name: one for role, one in stage.inputs.items() if role.startswith("generators.")}
    about |= {role: makers[name] for role, name in file.about.get("made_by", {}).items() if name in makers}
    return Evaluation(run, stage.name, file, about, stage.inputs.get("data"))


def _retrieval(path: Path, run: Path, stages: Mapping[str, StageRecord]) -> Evaluation:
    """The evaluation that the command `retrieval` wrote: figures by protocol, `A.t2m/R@1`."""
    file = FigureFile.read(path)
    stage = stages.get(str(file.about.get("stage")))
    if stage is None:
        raise UserError(f"{path}: not a record of motionloom retrieval on this run; run it again")
    if file.about.get("fingerprint") != stage.fingerprint:
        raise UserError(
            f"{path}: measured by another '{stage.name}' than is there now; measure again: "
            f"motionloom retrieval {run} --stage {stage.name}"
        )
    return Evaluation(run, path.name, file, {"alignment": stage}, stage.inputs.get("data"))
