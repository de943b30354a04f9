"""Evaluation: reconstruction, retrieval, generation on the test split, each beside its trivial answer."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from pydantic import Field
from rich.table import Table

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.showing import FigureTable, Showing
from motionloom.pipeline.contract.stage import (
    GENERATOR,
    SHOWING,
    Every,
    Finished,
    Given,
    StageConfig,
    StageContext,
    StageKind,
)
from motionloom.pipeline.evaluation.figures import (
    Interval,
    chance,
    embed_motions,
    reconstruction_figures,
    retrieval_figures,
    truth_agreement,
)
from motionloom.pipeline.evaluation.truth import Truth, captioned, spread, truth_of
from motionloom.pipeline.inference.bundle import Bundle, GeneratedMotion
from motionloom.pipeline.stages.progress import bar
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.networks import LoadedTma, TrainedTokenizer

_FILE = "metrics.json"


class EvaluateConfig(StageConfig):
    """How much is measured."""

    clips: int = Field(400, ge=1)
    """At most this many clips of the test split."""
    repeats: int = Field(20, ge=1)
    """Repetitions of generation and of drawing retrieval batches."""
    size: int = Field(32, ge=2)
    """Candidates in retrieval (32: protocol D; 256: protocol C)."""
    sampling: SamplingConfig = SamplingConfig()


class EvaluateStage(StageKind):
    """Reconstruction, retrieval and generation on the test split."""

    name = "evaluate"
    summary = "figures on the test split"
    config = EvaluateConfig
    takes = ("data", "text?", "tokenizer?", "tma?", Every("generators", GENERATOR))
    version = 3  # generators as the recipe has them

    def gives(self, config: Any) -> frozenset[str]:
        """Its tables."""
        return frozenset({"figures", SHOWING})

    def run(self, context: StageContext) -> None:
        """Write `metrics.json` and print it as tables."""
        figures = _plain(_Evaluation(context).figures())
        write_json(context.folder / _FILE, figures)
        for table in tables(figures):
            context.console.print(table)

    def show(self, stage: Finished, given: Given) -> list[Showing]:
        """The tables."""
        figures = json.loads((stage.folder / _FILE).read_text())
        return [FigureTable(title, columns, rows) for title, columns, rows in figure_rows(figures)]


class _Evaluation:
    """What one evaluation measures."""

    def __init__(self, context: StageContext) -> None:
        self.context, self.config = context, context.config
        self.tokenizer: TrainedTokenizer | None = context.given.get("tokenizer")
        self.tma: LoadedTma | None = context.given.get("tma")
        self.bundle = Bundle(context.every("generators"), context.shelf)
        self.dataset = context.given["data"].held_out(prefer="test")

    def figures(self) -> dict[str, Any]:
        """All figures, each beside its trivial answer."""
        dataset, context = self.dataset, self.context
        unit = self.tokenizer.net.group_frames if self.tokenizer else self.bundle.generator.unit_frames
        truths = [truth_of(dataset, i) for i in sorted(spread(dataset, self.config.clips))]
        truths = [t for t in truths if len(t.features) >= unit]
        if not truths:
            raise UserError(
                f"{dataset.where}: no captioned clip of split '{dataset.split}' is long enough for one group "
                f"of tokens"
            )
        if left := int((~captioned(dataset)).sum()):
            context.console.print(f"    {dataset.split}: {left} clips without a caption are left out")
        figures: dict[str, Any] = {"split": dataset.split, "clips": len(truths)}
        if self.tokenizer is not None:
            train = context.given["data"].split("train")
            figures["bits_per_second"] = self.tokenizer.net.bits_per_second
            figures["reconstruction_mm"] = reconstruction_figures(self.tokenizer, train, truths)
        generated = self.generate(truths)
        if self.tma is not None:
            figures["retrieval"] = self.retrieval(self.tma, truths, generated)
        if any(t.truth for t in truths):
            figures["agreement_with_caption"] = self.agreement(truths, generated)
        return figures

    def generate(self, truths: list[Truth]) -> list[list[GeneratedMotion]]:
        """The captions of `truths` performed, once for each repeat."""
        out, config, seed = [], self.config, self.context.seed
        with bar(self.context.console) as progress:
            task = progress.add_task("generating", total=config.repeats * len(truths), note="")
            for repeat in range(config.repeats):
                motions: list[GeneratedMotion] = []
                for start in range(0, len(truths), 64):
                    part = truths[start : start + 64]
                    motions += self.bundle.generate(
                        [t.caption for t in part],
                        face_captions=[t.face_caption for t in part],
                        seed=seed + 7919 * (repeat + 1) + start,
                        sampling=config.sampling,
                    )
                    progress.update(task, advance=len(part))
                out.append(motions)
        return out

    def retrieval(
        self, tma: LoadedTma, truths: list[Truth], generated: list[list[GeneratedMotion]]
    ) -> dict[str, Any]:
        """Recall among `size`, of real and of generated motion."""
        config, seed = self.config, self.context.seed
        size = min(config.size, len(truths))
        text = tma.embed_captions([t.caption for t in truths], self.context.given["text"].cache)
        real = embed_motions(tma, [t.features for t in truths], [t.held for t in truths])
        repeats = max(config.repeats, 5)
        figures = retrieval_figures(text, real, size=size, repeats=repeats, seed=seed)
        made: dict[str, list[float]] = {}
        for repeat, motions in enumerate(generated):
            latent = embed_motions(tma, [g.features for g in motions])
            once = retrieval_figures(text, latent, size=size, repeats=1, seed=seed + repeat)
            for name, value in once.items():
                made.setdefault(name, []).append(value.mean)
            distance = torch.linalg.vector_norm(text - latent, dim=-1).mean()
            made.setdefault("matching_score", []).append(float(distance))
        real_distance = float(torch.linalg.vector_norm(text - real, dim=-1).mean())
        return {
            "size": size,
            "chance": {f"r{k}": chance(k, size) for k in (1, 2, 3)},
            "real": {**figures, "matching_score": Interval(real_distance, 0.0)},
            "generated": {name: Interval.of(values) for name, values in made.items()},
        }

    def agreement(self, truths: list[Truth], generated: list[list[GeneratedMotion]]) -> dict[str, Any]:
        """Whether motions do what their captions say, by their joints."""
        fps = self.dataset.layout.fps
        made = [(t, g.joints, g.face) for motions in generated for t, g in zip(truths, motions, strict=True)]
        return {
            "truth": truth_agreement([(t, t.joints, t.face) for t in truths], fps),
            "generated": truth_agreement(made, fps),
        }


def _plain(value: Any) -> Any:
    if isinstance(value, Interval):
        return {k: round(v, 5) for k, v in asdict(value).items()}
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return round(float(value), 5) if isinstance(value, float | np.floating) else value


def tables(figures: dict[str, Any]) -> list[Table]:
    """The figures for people."""
    return [_table(title, columns, rows) for title, columns, rows in figure_rows(figures)]


def _table(title: str, columns: list[str], rows: list[list[str]]) -> Table:
    table = Table(*columns, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row)
    return table


def figure_rows(figures: dict[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """(title, columns, rows) of each table; the report draws the same ones."""
    out = []
    if "reconstruction_mm" in figures:
        out.append(_reconstruction_rows(figures))
    if "retrieval" in figures:
        found = figures["retrieval"]
        rows = [
            [
                "chance",
                *(f"{found['chance'][f'r{k}']:.3f}" for k in (1, 3)),
                *(f"{found['chance'][f'r{k}']:.3f}" for k in (1, 3)),
                "",
            ]
        ]
        for name in ("real", "generated"):
            keys = ("t2m_r1", "t2m_r3", "m2t_r1", "m2t_r3", "matching_score")
            rows.append([f"{name} motion", *(_interval(found[name][key]) for key in keys)])
        columns = ["", "text to motion R@1", "R@3", "motion to text R@1", "R@3", "matching score"]
        out.append((f"TMA retrieval among {found['size']}", columns, rows))
    if "agreement_with_caption" in figures:
        found = figures["agreement_with_caption"]
        names = sorted({*found["truth"], *found["generated"]})
        rows = [[n, *(_percent(found[k].get(n)) for k in ("truth", "generated"))] for n in names]
        out.append(
            (
                "Does the motion do what its caption says? (measured on the joints)",
                ["", "real", "generated"],
                rows,
            )
        )
    return out


def _reconstruction_rows(figures: dict[str, Any]) -> tuple[str, list[str], list[list[str]]]:
    r = figures["reconstruction_mm"]
    return (
        f"Reconstruction on {figures['clips']} {figures['split']} clips, mm (lower is better); "
        f"codes of {figures['bits_per_second']:.0f} bit/s",
        ["", "pose", "body", "fingers from the wrist", "in the world", "PA-MPJPE", "ACCEL"],
        [
            [
                title,
                *(_mm(r.get(f"{key}{suffix}")) for key in ("mpjpe", "mpjpe_body", "mpjpe_hand")),
                _mm(r[f"global_mpjpe{suffix}"]),
                *(_mm(r.get(key)) if not suffix else "" for key in ("pa_mpjpe", "accel")),
            ]
            for title, suffix in (
                ("tokenizer", ""),
                ("nearest training clip", "_nearest_train_clip"),
                ("mean pose", "_mean_pose"),
            )
        ],
    )


def _mm(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.0f} %"


def _interval(value: dict[str, float]) -> str:
    return f"{value['mean']:.3f} ± {value['half_width']:.3f}"
