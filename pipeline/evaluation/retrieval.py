"""Text-motion retrieval by a trained TMA, or by TEMOS, under the paper's four protocols (HumanTOMATO D.2)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from motionloom.datasets.schema import UserError
from motionloom.models.metrics.retrieval import RECALLS, recall
from motionloom.pipeline.contract.lookup import finished_stages, stages_giving
from motionloom.pipeline.contract.stage import ALIGNMENT, Finished, Shelf
from motionloom.pipeline.evaluation.figures import embed_motions
from motionloom.pipeline.evaluation.truth import truth_of
from motionloom.pipeline.launch.hardware import choose_device
from motionloom.pipeline.store.artifact import require_consistent
from motionloom.pipeline.store.files import write_json

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
    run: Path, stage: str | None = None, *, split: str | None = None, seed: int = 0, device: str = "auto"
) -> list[ProtocolResult]:
    """All four protocols for one alignment stage of a run, on a split of its data.

    By default its stage `tma`, or else its first, on its test split or else another one held out.
    """
    found = alignment_stage(run, stage)
    shelf = Shelf(choose_device(device))
    tma, given = shelf.get(found), shelf.given_to(found)
    data, cache = given["data"], given["text"].cache
    dataset = data.split(split) if split else data.held_out(prefer="test")
    truths = [truth_of(dataset, i) for i in range(len(dataset))]
    truths = [t for t in truths if t.caption and len(t.features) >= 4]
    if len(truths) < 2:
        raise UserError(
            f"{run}: split '{dataset.split}' has {len(truths)} captioned clips; retrieval needs 2"
        )
    captions = [t.caption for t in truths]
    text = tma.embed_captions(captions, cache)
    motion = embed_motions(tma, [t.features for t in truths], [t.present for t in truths])
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


def alignment_stage(run: Path, name: str | None = None) -> Finished:
    """A finished stage that aligns text with motion: by name, else `tma`, else the recipe's first."""
    aligned = stages_giving(run, ALIGNMENT)
    if name is None:
        name = "tma" if "tma" in aligned or not aligned else aligned[0]
    if name not in aligned:
        known = f"this run has {', '.join(aligned)}" if aligned else "this run has none"
        raise UserError(f"{run}: no stage '{name}' that aligns text with body and hands; {known}")
    found = finished_stages(run).get(name)
    if found is None:
        raise UserError(f"{run}: no finished '{name}' stage; run the recipe up to it first")
    missing = [role for role in ("data", "stats", "text") if role not in found.inputs]
    if missing:
        said = f"{run}: no finished '{missing[0]}' stage; run the recipe up to it first"
        raise UserError(found.gone.get(missing[0], said))
    require_consistent(run, [name])
    return found


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
    main = alignment_stage(run).name
    stage = stage or main
    rows = retrieve(run, stage, split=split, seed=seed, device=device)
    console.print(retrieval_table(rows, "TMA retrieval" if stage == main else f"Retrieval of stage {stage}"))
    path = run / ("retrieval.json" if stage == main else f"retrieval-{stage}.json")
    facts = {"stage": stage, "threshold": THRESHOLD, "seed": seed}
    write_json(path, {**facts, "protocols": [asdict(row) for row in rows]})
    console.print(str(path), soft_wrap=True)
    return path
