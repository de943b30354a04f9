"""Text-motion retrieval by a trained TMA, or by TEMOS, under the paper's four protocols (HumanTOMATO D.2)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from motionloom.datasets.loading.statistics import FeatureStats
from motionloom.datasets.schema import UserError
from motionloom.models.metrics.retrieval import RECALLS, recall
from motionloom.pipeline.evaluation.figures import embed_motions
from motionloom.pipeline.evaluation.truth import truth_of
from motionloom.pipeline.inference.bundle import part_folders, stages_of
from motionloom.pipeline.launch.hardware import choose_device
from motionloom.pipeline.runs.graph import stage_folder
from motionloom.pipeline.store.artifact import require_consistent
from motionloom.pipeline.store.data import held_out, open_split, open_text
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.networks import LoadedTma

THRESHOLD = 0.9
"""Protocol B: captions with a higher sentence cosine count as the same."""

BATCHES = {"C": 256, "D": 32}


@dataclass(frozen=True)
class ProtocolResult:
    """Recall@1/2/3/5/10 both ways under one protocol; fractions."""

    protocol: str
    meaning: str
    size: int
    """Candidates."""
    figures: dict[str, float]
    """"t2m/R@1" ..., "t2m/MedR", and the same for "m2t"."""


def retrieve(
    run: Path, stage: str = "tma", *, split: str | None = None, seed: int = 0, device: str = "auto"
) -> list[ProtocolResult]:
    """All four protocols for one alignment stage of a run, on a split of its data.

    By default its test split, else another held out.
    """
    parts = _folders(run, stage)
    data = parts["data"]
    dataset = open_split(data, split or held_out(data, prefer="test"))
    tma = LoadedTma.load(parts["model"], choose_device(device))
    stats = FeatureStats.load(parts["stats"] / "stats.safetensors")
    cache = open_text(parts["text"])
    truths = [truth_of(dataset, i) for i in range(len(dataset))]
    truths = [t for t in truths if t.caption and len(t.features) >= 4]
    if len(truths) < 2:
        raise UserError(
            f"{run}: split '{dataset.split}' has {len(truths)} captioned clips; retrieval needs 2"
        )
    captions = [t.caption for t in truths]
    text = tma.embed_captions(captions, cache)
    motion = embed_motions(tma, stats, [t.features for t in truths], [t.present for t in truths])
    sentence = torch.as_tensor(cache.similarity(captions))
    rows = [
        _result("A", "whole split", recall(text, motion)),
        _result(
            "B",
            f"same meaning counts (cosine {THRESHOLD:g})",
            recall(text, motion, sentence=sentence, threshold=THRESHOLD),
        ),
    ]
    for name, size in BATCHES.items():
        rows.append(_result(name, f"batches of {size}", recall(text, motion, batch=size, seed=seed)))
    return rows


def _folders(run: Path, stage: str) -> dict[str, Path]:
    """Folders of an alignment model ("model") and of what it was trained on, all finished."""
    stages = stages_of(run)
    aligned = [name for name, entry in stages.items() if entry["kind"] == "tma" and not _of_face(entry)]
    if stage not in aligned:
        known = f"this run has {', '.join(aligned)}" if aligned else "this run has none"
        raise UserError(f"{run}: no stage '{stage}' that aligns text with body and hands; {known}")
    inputs = stages[stage].get("inputs", {})
    roles = {"model": stage, **{role: inputs.get(role) or role for role in ("data", "stats", "text")}}
    found = {role: stage_folder(run, name) for role, name in roles.items()}
    for folder in found.values():
        if not (folder / "artifact.json").is_file():
            raise UserError(f"{run}: no finished '{folder.name}' stage; run the recipe up to it first")
    require_consistent(run, (folder.name for folder in found.values()))
    return found


def _of_face(entry: dict[str, Any]) -> bool:
    return entry.get("part") == "face"


def _result(protocol: str, meaning: str, figures: dict[str, float]) -> ProtocolResult:
    size = int(figures.pop("size"))
    return ProtocolResult(protocol, meaning, size, figures)


def retrieval_table(rows: list[ProtocolResult], title: str) -> Table:
    """For a terminal: both ways, with what a guess would get."""
    table = Table(title=title, title_justify="left")
    for column in ("protocol", "", "among", "way", *(f"R@{k}" for k in RECALLS), "median rank"):
        table.add_column(column)
    for row in rows:
        for way, title in (("t2m", "text to motion"), ("m2t", "motion to text")):
            shares = [f"{100 * row.figures[f'{way}/R@{k}']:.1f} %" for k in RECALLS]
            first = (row.protocol, row.meaning, str(row.size)) if way == "t2m" else ("", "", "")
            table.add_row(*first, title, *shares, f"{row.figures[f'{way}/MedR']:.1f}")
        guess = [f"{100 * min(1.0, k / row.size):.1f} %" for k in RECALLS]
        table.add_row("", "", "", "[dim]a guess[/]", *(f"[dim]{g}[/]" for g in guess), "", end_section=True)
    return table


def retrieval_command(
    run: Path,
    *,
    stage: str | None = None,
    split: str | None,
    seed: int,
    device: str = "auto",
    console: Console,
) -> Path:
    """Print the table and write RUN/retrieval.json; of another `stage` than TMA, RUN/retrieval-STAGE.json."""
    main = part_folders(run).get("tma", Path("tma")).name
    stage = stage or main
    rows = retrieve(run, stage, split=split, seed=seed, device=device)
    console.print(retrieval_table(rows, "TMA retrieval" if stage == main else f"Retrieval of stage {stage}"))
    path = run / ("retrieval.json" if stage == main else f"retrieval-{stage}.json")
    facts = {"stage": stage, "threshold": THRESHOLD, "seed": seed}
    write_json(path, {**facts, "protocols": [asdict(row) for row in rows]})
    console.print(str(path), soft_wrap=True)
    return path
