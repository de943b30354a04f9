"""Evaluation: reconstruction, retrieval, generation on the test split, each beside its trivial answer."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from pydantic import Field
from rich.table import Table

from motionloom.datasets.schema import UserError
from motionloom.pipeline.evaluation.figures import (
    Interval,
    chance,
    embed_motions,
    reconstruction_figures,
    retrieval_figures,
    truth_agreement,
)
from motionloom.pipeline.evaluation.truth import Truth, captioned, spread, truth_of
from motionloom.pipeline.inference.bundle import Bundle, text_encoder_of
from motionloom.pipeline.inference.sampling import SamplingConfig
from motionloom.pipeline.stages.progress import bar
from motionloom.pipeline.stages.stage import StageConfig, StageContext
from motionloom.pipeline.store.data import held_out, open_split, open_text
from motionloom.pipeline.store.files import write_json


class EvaluateConfig(StageConfig):
    """How much is measured."""

    clips: int = Field(400, ge=1)
    """At most this many clips of the test split."""
    repeats: int = Field(20, ge=1)
    """Repetitions of generation and of drawing retrieval batches."""
    size: int = Field(32, ge=2)
    """Candidates in retrieval (32: protocol D; 256: protocol C)."""
    sampling: SamplingConfig = SamplingConfig()


def run_evaluate(context: StageContext) -> None:
    """Write `metrics.json` and print it as tables."""
    config: EvaluateConfig = context.config
    data = context.input("data")
    bundle = Bundle.from_parts(dict(context.inputs), text_encoder_of(context.input("text")), context.device)
    split = held_out(data, prefer="test")
    dataset = open_split(data, split)
    truths = [truth_of(dataset, i) for i in sorted(spread(dataset, config.clips))]
    truths = [t for t in truths if len(t.features) >= bundle.tokenizer.group_frames]
    if not truths:
        raise UserError(
            f"{dataset.where}: no captioned clip of split '{split}' is long enough for one group of tokens"
        )
    if left := int((~captioned(dataset)).sum()):
        context.console.print(f"    {split}: {left} clips without a caption are left out")
    figures: dict[str, Any] = {"split": split, "clips": len(truths)}
    figures["bits_per_second"] = bundle.tokenizer.bits_per_second
    figures["reconstruction_mm"] = reconstruction_figures(
        bundle.tokenizer, bundle.stats, open_split(data, "train"), truths
    )
    generated = _generate(bundle, truths, config, context)
    if bundle.tma is not None:
        figures.update(_retrieval(bundle, truths, generated, config, context))
    if any(t.truth for t in truths):
        figures["agreement_with_caption"] = {
            "truth": truth_agreement([(t, t.joints, t.face) for t in truths], dataset.layout.fps),
            "generated": truth_agreement(
                [
                    (t, g.joints, g.face)
                    for motions in generated
                    for t, g in zip(truths, motions, strict=True)
                ],
                dataset.layout.fps,
            ),
        }
    write_json(context.folder / "metrics.json", _plain(figures))
    for table in tables(_plain(figures)):
        context.console.print(table)


def _generate(
    bundle: Bundle, truths: list[Truth], config: EvaluateConfig, context: StageContext
) -> list[list]:
    out = []
    with bar(context.console) as progress:
        task = progress.add_task("generating", total=config.repeats * len(truths), note="")
        for repeat in range(config.repeats):
            motions = []
            for start in range(0, len(truths), 64):
                part = truths[start : start + 64]
                motions += bundle.generate(
                    [t.caption for t in part],
                    face_captions=[t.face_caption for t in part],
                    seed=context.seed + 7919 * (repeat + 1) + start,
                    sampling=config.sampling,
                )
                progress.update(task, advance=len(part))
            out.append(motions)
    return out


def _retrieval(
    bundle: Bundle, truths: list[Truth], generated: list[list], config: EvaluateConfig, context: StageContext
) -> dict[str, Any]:
    assert bundle.tma is not None
    size = min(config.size, len(truths))
    text = bundle.tma.embed_captions([t.caption for t in truths], open_text(context.input("text")))
    real = embed_motions(bundle.tma, bundle.stats, [t.features for t in truths], [t.present for t in truths])
    repeats = max(config.repeats, 5)
    figures = retrieval_figures(text, real, size=size, repeats=repeats, seed=context.seed)
    made: dict[str, list[float]] = {}
    for repeat, motions in enumerate(generated):
        latent = embed_motions(bundle.tma, bundle.stats, [g.features for g in motions])
        once = retrieval_figures(text, latent, size=size, repeats=1, seed=context.seed + repeat)
        for name, value in once.items():
            made.setdefault(name, []).append(value.mean)
        distance = torch.linalg.vector_norm(text - latent, dim=-1).mean()
        made.setdefault("matching_score", []).append(float(distance))
    real_distance = float(torch.linalg.vector_norm(text - real, dim=-1).mean())
    return {
        "retrieval": {
            "size": size,
            "chance": {f"r{k}": chance(k, size) for k in (1, 2, 3)},
            "real": {**figures, "matching_score": Interval(real_distance, 0.0)},
            "generated": {name: Interval.of(values) for name, values in made.items()},
        }
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
    r = figures["reconstruction_mm"]
    out.append(
        (
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
    )
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


def _mm(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.0f} %"


def _interval(value: dict[str, float]) -> str:
    return f"{value['mean']:.3f} ± {value['half_width']:.3f}"
