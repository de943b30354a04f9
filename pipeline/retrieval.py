"""Text-motion retrieval of a trained TMA under the paper's four protocols (HumanTOMATO section D.2)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.statistics import FeatureStats
from motionloom.models.metrics.retrieval import RECALLS, recall
from motionloom.pipeline.bundle import part_folders
from motionloom.pipeline.evaluation import embed_motions
from motionloom.pipeline.files import write_json
from motionloom.pipeline.graph import stage_folder
from motionloom.pipeline.networks import LoadedTma
from motionloom.pipeline.samples import truth_of
from motionloom.pipeline.sources import held_out, open_split, open_text

THRESHOLD = 0.9
"""Protocol B: captions with a higher sentence cosine count as the same."""

BATCHES = {"C": 256, "D": 32}
RESULT = "retrieval.json"


@dataclass(frozen=True)
class ProtocolResult:
    """Recall@1/2/3/5/10 both ways under one protocol; fractions."""

    protocol: str
    meaning: str
    size: int
    """Candidates."""
    figures: dict[str, float]
    """"t2m/R@1" ..., "t2m/MedR", and the same for "m2t"."""


def retrieve(run: Path, *, split: str | None = None, seed: int = 0) -> list[ProtocolResult]:
    """All four protocols on a split of a finished run; by default its test split, else another held out."""
    parts = part_folders(run)
    for role in ("tma", "stats", "text"):
        if role not in parts:
            raise UserError(f"{run}: no finished '{role}' stage; run the recipe up to it first")
    data = stage_folder(run, "data")
    dataset = open_split(data, split or held_out(data, prefer="test"))
    tma, stats = LoadedTma.load(parts["tma"]), FeatureStats.load(parts["stats"] / "stats.safetensors")
    cache = open_text(parts["text"])
    truths = [truth_of(dataset, i) for i in range(len(dataset))]
    truths = [t for t in truths if t.caption and len(t.features) >= 4]
    if len(truths) < 2:
        raise UserError(
            f"{run}: split '{dataset.split}' has {len(truths)} captioned clips; retrieval needs 2"
        )
    captions = [t.caption for t in truths]
    text = tma.embed_captions(captions, cache)
    motion = embed_motions(tma, stats, [t.features for t in truths], [t.held for t in truths])
    sentence = torch.as_tensor(cache.sentence(captions))
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


def _result(protocol: str, meaning: str, figures: dict[str, float]) -> ProtocolResult:
    size = int(figures.pop("size"))
    return ProtocolResult(protocol, meaning, size, figures)


def retrieval_table(rows: list[ProtocolResult]) -> Table:
    """For a terminal: both ways, with what a guess would get."""
    table = Table(title="TMA retrieval", title_justify="left")
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


def retrieval_command(run: Path, *, split: str | None, seed: int, console: Console) -> Path:
    """Print the table and write RUN/retrieval.json."""
    rows = retrieve(run, split=split, seed=seed)
    console.print(retrieval_table(rows))
    path = run / RESULT
    write_json(path, {"threshold": THRESHOLD, "seed": seed, "protocols": [asdict(row) for row in rows]})
    console.print(str(path), soft_wrap=True)
    return path
