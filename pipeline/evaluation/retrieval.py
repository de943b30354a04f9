"""Text-motion retrieval by a trained TMA, by TEMOS or by an evaluator, under the paper's four protocols
(HumanTOMATO D.2).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of
from motionloom.models.metrics.retrieval import RECALLS, Distance, recall
from motionloom.pipeline.contract.lookup import finished_stages, stages_giving
from motionloom.pipeline.contract.stage import ALIGNMENT, CompletedStage, Role, StageCache
from motionloom.pipeline.evaluation.estimate import plain
from motionloom.pipeline.evaluation.figures import (
    CHANCE,
    MODEL,
    Figure,
    FigureFile,
    Metric,
    group_figures,
    print_tables,
)
from motionloom.pipeline.evaluation.judges import Judge
from motionloom.pipeline.evaluation.truth import digest_of, truth_of
from motionloom.pipeline.launch.hardware import choose_device
from motionloom.pipeline.store.artifact import fingerprint_now, require_consistent
from motionloom.pipeline.store.evaluator import LoadedEvaluator
from motionloom.pipeline.store.run_folder import require_own
from motionloom.pipeline.store.weights import MODEL_FILES

THRESHOLD = 0.9
"""Protocol B: captions with a higher sentence cosine count as the same."""

BATCHES = {"C": 256, "D": 32}


def retrieve(
    run: Path, stage: str | None = None, *, split: str | None = None, seed: int = 0, device: str = "auto"
) -> FigureFile:
    """Recall@1/2/3/5/10 and the median rank both ways under each protocol, for one judge of a run on a split
    of its data: figures `A.t2m/R@1`. Protocol B where captions can be compared.

    By default its stage `tma`, or else its first, on its test split or else another one held out. An
    evaluator's latents are compared by Euclidean distance, as its training and its figures have it; those
    of TMA and TEMOS by cosine.
    """
    source = alignment_stage(run, stage)
    stage_cache = StageCache(choose_device(device))
    model = stage_cache.get(source)
    inputs = _sources(run, source)
    data = stage_cache.get(inputs["data"])
    judge = Judge(model)
    # Latents are compared as the judge's own training compared them.
    distance: Distance = "cosine"
    if isinstance(model, LoadedEvaluator):
        model.require_layout(data.layout, source.name)
        distance = "euclidean"
    dataset = data.split(split) if split else data.held_out(prefer="test")
    truths = [truth_of(dataset, i) for i in range(len(dataset))]
    truths = [t for t in truths if t.caption and len(t.features) >= 4]
    if len(truths) < 2:
        raise UserError(
            f"{run}: split '{dataset.split}' has {len(truths)} captioned clips; retrieval needs 2"
        )
    text = judge.texts(truths)
    motion = judge.recorded(truths)
    found_by = {"A": ("whole split", recall(text, motion, distance=distance))}
    # Only a sentence encoder can tell which captions say the same.
    if "text" in inputs:
        sentence = torch.as_tensor(
            stage_cache.get(inputs["text"]).cache.similarity([t.caption for t in truths])
        )
        found_same = recall(text, motion, sentence=sentence, threshold=THRESHOLD, distance=distance)
        found_by["B"] = f"same meaning counts (cosine {THRESHOLD:g})", found_same
    for name, size in BATCHES.items():
        found_in = recall(text, motion, batch=size, seed=seed, distance=distance)
        found_by[name] = f"batches of {size}", found_in
    facts = {
        "stage": source.name,
        "kind": source.kind.name,
        "fingerprint": fingerprint_now(source.folder),
        "sha256": sha256_of(source.folder / MODEL_FILES[0]),
        "distance": distance,
        "split": dataset.split,
        "clips": len(truths),
        "clips_sha256": digest_of(truths),
        "threshold": THRESHOLD,
        "seed": seed,
    }
    figures = [one for name, by in found_by.items() for one in _figures(name, *by, facts)]
    return FigureFile("retrieval", tuple(figures), facts)


def alignment_stage(run: Path, name: str | None = None) -> CompletedStage:
    """Return the judge of that name, else `tma`, else the recipe's first; evaluators come last."""
    names = _judges(run)
    name = name or (names or ["tma"])[0]
    if name not in names:
        have = f"this run has {', '.join(names)}" if names else "this run has none"
        raise UserError(f"{run}: no stage '{name}' that aligns text with body and hands; {have}")
    stage = finished_stages(run).get(name)
    if stage is None:
        raise UserError(f"{run}: no finished '{name}' stage; run the recipe up to it first")
    needed = [role.name for role in stage.kind.roles() if isinstance(role, Role) and not role.optional]
    missing = [role for role in needed if role not in stage.inputs]
    if missing:
        raise UserError(f"{run}: no finished '{missing[0]}' stage; run the recipe up to it first")
    require_consistent(run, [name])
    return stage


def _judges(run: Path) -> list[str]:
    """Names of the stages of a run's recipe that can judge, the one that does by default first."""
    names = [*stages_giving(run, ALIGNMENT), *stages_giving(run, "evaluator")]
    return sorted(names, key=lambda name: name != "tma")


def _sources(run: Path, judge: CompletedStage) -> dict[str, CompletedStage]:
    """The stages of the clips and of the captions' meaning: a judge's own, else the run's first of each.

    The published evaluator was made from no stage of the run.
    """
    out = {}
    finished = finished_stages(run)
    for what in ("data", "text"):
        own = [stage for stage in finished.values() if stage.kind.name == what or stage.gives(what)]
        if what in judge.inputs or own:
            out[what] = judge.inputs.get(what) or own[0]
    if "data" not in out:
        raise UserError(f"{run}: no finished 'data' stage; run the recipe up to it first")
    return out


_WAYS = {"t2m": "text to motion", "m2t": "motion to text"}


def _figures(name: str, meaning: str, values: dict[str, float], facts: dict[str, Any]) -> list[Figure]:
    """Figures of one protocol beside chance, a table for each way."""
    size = int(values["size"])
    protocol = {key: facts[key] for key in ("split", "clips", "clips_sha256", "distance", "threshold")}
    protocol |= {"judge": facts["sha256"], "candidates": size}
    out = []
    for way, words in _WAYS.items():
        shares = [Metric(f"{name}.{way}/R@{k}", f"R@{k}", "higher", "share") for k in RECALLS]
        guess = {one.name: min(1.0, k / size) for one, k in zip(shares, RECALLS, strict=True)}
        metrics = [*shares, Metric(f"{name}.{way}/MedR", "median rank", "lower")]
        measured = {one.name: values[one.name.removeprefix(f"{name}.")] for one in metrics}
        rows = {MODEL: plain(measured), CHANCE: plain(guess)}
        out += group_figures(f"Protocol {name}, {words}: {meaning}", metrics, rows, protocol)
    return out


def retrieval_command(run: Path, *, stage: str | None = None, console: Console) -> Path:
    """Print the table and write RUN/retrieval.json, or RUN/retrieval-STAGE.json of a given stage."""
    require_own(run)
    file = retrieve(run, stage)
    print_tables(file.figures, console)
    stage = file.about["stage"]
    path = run / ("retrieval.json" if stage == _judges(run)[0] else f"retrieval-{stage}.json")
    file.write(path)
    console.print(str(path), markup=False, soft_wrap=True)
    return path
