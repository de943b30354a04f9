"""What a run has measured: its finished evaluations, their figures, and which stages each is about."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from motionloom.datasets.schema import UserError
from motionloom.pipeline.evaluation.versions import EVALUATE, EVALUATE_DANCES
from motionloom.pipeline.published.conditions import value_at
from motionloom.pipeline.published.schema import Measure
from motionloom.pipeline.published.stages import RunStage, run_stages
from motionloom.pipeline.store.artifact import require_consistent
from motionloom.pipeline.store.run_folder import stage_folder
from motionloom.pipeline.store.run_state import read_record

_FILES = {"evaluate": ("metrics.json", EVALUATE), "evaluate_dances": ("dances.json", EVALUATE_DANCES)}
_METHODS = {"gpt": "gpt", "tma": "vae", "diffusion": "diffusion"}
"""What `sampling.face_model` calls a stage kind."""


@dataclass(frozen=True)
class Evaluation:
    """Figures of one evaluation, and the stages that it is about, by role (`schema.ROLES`)."""

    run: Path
    name: str
    """Its stage, or the file of the command `retrieval`."""
    measure: Measure
    figures: Mapping[str, Any]
    about: Mapping[str, RunStage]
    data: RunStage | None
    config: Mapping[str, Any]

    def value(self, key: str) -> tuple[float, float | None] | None:
        """A figure and the half-width of its interval, None where nothing was repeated; None without a
        finite one.
        """
        found = value_at(self.figures, key, None)
        if isinstance(found, Mapping):
            half = found.get("half_width")
            found, spread = found.get("mean"), half if isinstance(half, float | int) and half else None
        else:
            spread = None
        if isinstance(found, bool) or not isinstance(found, float | int) or not math.isfinite(found):
            return None
        return float(found), None if spread is None else float(spread)


def evaluations_of(run: Path, measures: Iterable[Measure]) -> list[Evaluation]:
    """All that a run has of `measures`, in the recipe's order; a `UserError` where it has none."""
    stages, wanted = run_stages(run), tuple(measures)
    found = [
        _staged(run, stage, list(stages))
        for stage in stages.values()
        if stage.kind in _FILES and stage.kind in wanted
    ]
    if "retrieval" in wanted:
        found += [_retrieval(path, run, stages) for path in sorted(run.glob("retrieval*.json"))]
    if not found:
        raise UserError(
            f"{run}: no finished evaluation that this table takes figures of; {_fix(run, wanted)}"
        )
    return found


def _fix(run: Path, wanted: Iterable[Measure]) -> str:
    if "retrieval" in wanted:
        return f"make one: motionloom retrieval {run}"
    kinds = " or ".join(wanted)
    return f"finish a stage of kind {kinds}: motionloom run {run / 'recipe.yaml'} -o {run}"


def _staged(run: Path, stage: RunStage, order: list[str]) -> Evaluation:
    """What an evaluating stage wrote."""
    file, version = _FILES[stage.kind]
    path = stage_folder(run, stage.name) / file
    if stage.version != version:
        raise UserError(
            f"{path}: made by version {stage.version} of stage kind {stage.kind}, whose figures meant "
            f"something else than those of version {version}; run the recipe again: "
            f"motionloom run {run / 'recipe.yaml'} -o {run}"
        )
    require_consistent(run, [stage.name])
    figures = read_record(path)
    about = {role: stage.inputs[role] for role in ("tokenizer", "face_tokenizer") if role in stage.inputs}
    about |= _generators(stage, figures, order)
    measure: Measure = "evaluate" if stage.kind == "evaluate" else "evaluate_dances"
    if measure == "evaluate":
        figures = _with_body(_with_guesses(figures))
    return Evaluation(run, stage.name, measure, figures, about, stage.inputs.get("data"), stage.config)


def _generators(stage: RunStage, figures: Mapping[str, Any], order: list[str]) -> dict[str, RunStage]:
    """The generator that made the motions, and the face's, as `Bundle` chooses them."""
    inputs = {one.name: one for role, one in stage.inputs.items() if role.startswith("generators.")}
    listed = value_at(figures, "protocol.generators", None) or sorted(inputs, key=_place(order))
    makers = [inputs[name] for name in listed if name in inputs]
    bodies = [maker for maker in makers if not maker.of_faces]
    if stage.kind == "evaluate_dances":
        bodies = [maker for maker in bodies if any(one.kind == "audio" for one in maker.upstream())]
    faces = [maker for maker in makers if maker.of_faces]
    chosen = value_at(stage.config, "sampling.face_model", None)
    faces = [face for face in faces if chosen in (face.name, _METHODS.get(face.kind))] or faces
    out = {"generator": bodies[:1], "face_generator": faces[:1]}
    return {role: found[0] for role, found in out.items() if found}


def _place(order: list[str]) -> Callable[[str], int]:
    """Where a stage stands in the recipe; those of other runs come last."""
    places = {name: number for number, name in enumerate(order)}
    return lambda name: places.get(name, len(places))


def _retrieval(path: Path, run: Path, stages: Mapping[str, RunStage]) -> Evaluation:
    """What the command `retrieval` wrote: figures by protocol, `A.t2m/R@1`."""
    data = read_record(path)
    protocols, stage = data.get("protocols"), stages.get(str(data.get("stage")))
    if not isinstance(protocols, list) or stage is None:
        raise UserError(f"{path}: not a record of motionloom retrieval on this run; run it again")
    if data.get("fingerprint") != stage.fingerprint:
        raise UserError(
            f"{path}: measured by another '{stage.name}' than is there now; measure again: "
            f"motionloom retrieval {run} --stage {stage.name}"
        )
    figures: dict[str, Any] = {key: data[key] for key in ("split", "clips_sha256", "sha256") if key in data}
    for row in protocols:
        values, size = value_at(row, "figures", None), value_at(row, "size", None)
        if not isinstance(values, dict) or not isinstance(size, int) or size < 1:
            raise UserError(f"{path}: key 'protocols' is not as motionloom retrieval writes it; run it again")
        ranks = {key: min(1.0, int(key.split("@")[1]) / size) for key in values if "/R@" in key}
        guess = {key.replace("t2m", "guess").replace("m2t", "guess"): share for key, share in ranks.items()}
        figures[str(row.get("protocol"))] = {**values, **guess, "size": size}
    return Evaluation(
        run, path.name, "retrieval", figures, {"alignment": stage}, stage.inputs.get("data"), data
    )


def _with_guesses(figures: dict[str, Any]) -> dict[str, Any]:
    """The file has no guesses of `top-1` and `top-5`; they follow from the number of candidates."""
    found, among = figures.get("retrieval"), value_at(figures, "retrieval.among", None)
    if not isinstance(found, dict) or not isinstance(among, int) or among < 1:
        return figures
    chance = {**found.get("chance", {}), **{f"top-{k}": min(1.0, k / among) for k in (1, 5)}}
    return {**figures, "retrieval": {**found, "chance": chance}}


def _with_body(figures: dict[str, Any]) -> dict[str, Any]:
    """Of motions without hands the file has the errors of all joints, which are the body's."""
    found = figures.get("reconstruction_mm")
    if not isinstance(found, dict) or "mpjpe_body" in found:
        return figures
    body = {}
    for metric in ("pa_mpjpe", "mpjpe", "accel"):
        for key, value in found.items():
            if key == metric or key.startswith(f"{metric}_"):
                body[f"{metric}_body{key.removeprefix(metric)}"] = value
    return {**figures, "reconstruction_mm": {**found, **body}}
