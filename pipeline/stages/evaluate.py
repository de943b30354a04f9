"""Evaluation: reconstruction, retrieval, generation on the test split, each beside its trivial answer."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import torch
from pydantic import Field
from torch import Tensor

from motionloom.datasets.schema import UserError
from motionloom.models.metrics.dance_choice import accuracy_among
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
from motionloom.pipeline.evaluation.tables import plain, print_tables
from motionloom.pipeline.evaluation.truth import Truth, has_caption, spread, spread_any, truth_of
from motionloom.pipeline.inference.bundle import Bundle, GeneratedMotion
from motionloom.pipeline.inference.driven import bundle_driven_by
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
    among: int = Field(61, ge=2)
    """Candidates of the accuracy of UDE's Table 1."""
    sampling: SamplingConfig = SamplingConfig()


class EvaluateStage(StageKind):
    """Reconstruction, retrieval and generation on the test split."""

    name = "evaluate"
    summary = "figures on the test split"
    config = EvaluateConfig
    takes = ("data", "text?", "tokenizer?", "tma?", Every("generators", GENERATOR))
    version = 4  # clips without captions are reconstructed too; accuracy among 61

    def gives(self, config: Any) -> frozenset[str]:
        """Its tables."""
        return frozenset({"figures", SHOWING})

    def run(self, context: StageContext) -> None:
        """Write `metrics.json` and print it as tables."""
        figures = plain(_Evaluation(context).figures())
        write_json(context.folder / _FILE, figures)
        print_tables(context.console, figure_rows(figures))

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
        makers = context.every("generators")
        self.bundle = bundle_driven_by("text", makers, context.shelf) or Bundle(makers, context.shelf)
        self.dataset = context.given["data"].held_out(prefer="test")

    def figures(self) -> dict[str, Any]:
        """All figures, each beside its trivial answer."""
        dataset, context = self.dataset, self.context
        unit = self.tokenizer.net.group_frames if self.tokenizer else self.bundle.generator.unit_frames
        said = has_caption(dataset)
        chosen = spread(dataset, self.config.clips) if said.any() else []
        truths = self.truths(chosen, unit)
        figures: dict[str, Any] = {"split": dataset.split, "clips": len(truths)}
        if self.tokenizer is not None:
            train = context.given["data"].split("train")
            shown = truths if said.all() else self.truths(spread_any(dataset, self.config.clips), unit)
            figures["bits_per_second"] = self.tokenizer.net.bits_per_second
            figures["reconstructed_clips"] = len(shown)
            if shown:
                figures["reconstruction_mm"] = reconstruction_figures(self.tokenizer, train, shown)
        if not truths and "reconstruction_mm" not in figures:
            raise UserError(
                f"{dataset.where}: no captioned clip of split '{dataset.split}' is long enough for one group "
                f"of tokens"
            )
        if left := int((~said).sum()):
            rest = "are left out" if self.tokenizer is None else "are left out, except of the reconstruction"
            context.console.print(f"    {dataset.split}: {left} clips without a caption {rest}")
        if not truths or "text" not in self.bundle.generator.modalities:
            return figures
        generated = self.generate(truths)
        if self.tma is not None:
            figures["retrieval"] = self.retrieval(self.tma, truths, generated)
        if any(t.truth for t in truths):
            figures["agreement_with_caption"] = self.agreement(truths, generated)
        return figures

    def truths(self, chosen: Sequence[int], unit: int) -> list[Truth]:
        """The clips `chosen` that are long enough for one group of tokens."""
        found = [truth_of(self.dataset, i) for i in sorted(chosen)]
        return [truth for truth in found if len(truth.features) >= unit]

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
        real = embed_motions(tma, [t.features for t in truths], [t.present for t in truths])
        repeats = max(config.repeats, 5)
        # A caption that says the same as the own one is no wrong answer.
        words = [t.caption for t in truths]
        same = torch.tensor([[one == other for other in words] for one in words])
        among = min(config.among, 1 + int((~same).sum(1).min()))

        def accuracy(latent: Tensor) -> dict[str, float]:
            if among < 2:
                return {}
            return accuracy_among(latent, text, candidates=among, same=same, seed=seed)

        figures = retrieval_figures(text, real, size=size, repeats=repeats, seed=seed)
        made: dict[str, list[float]] = {}
        for repeat, motions in enumerate(generated):
            latent = embed_motions(tma, [g.features for g in motions])
            once = retrieval_figures(text, latent, size=size, repeats=1, seed=seed + repeat)
            for name, value in once.items():
                made.setdefault(name, []).append(value.mean)
            for name, share in accuracy(latent).items():
                made.setdefault(name, []).append(share)
            distance = torch.linalg.vector_norm(text - latent, dim=-1).mean()
            made.setdefault("matching_score", []).append(float(distance))
        real_distance = float(torch.linalg.vector_norm(text - real, dim=-1).mean())
        return {
            "size": size,
            "among": among,
            "chance": {f"r{k}": chance(k, size) for k in (1, 2, 3)},
            "real": {
                **figures,
                **{name: Interval(share, 0.0) for name, share in accuracy(real).items()},
                "matching_score": Interval(real_distance, 0.0),
            },
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
        if "top-1" in found["real"]:
            tops = [
                [f"{name} motion", *(_interval(found[name][f"top-{k}"]) for k in (1, 5))]
                for name in ("real", "generated")
            ]
            guess = ["chance", *(f"{min(1.0, chance(k, found['among'])):.3f}" for k in (1, 5))]
            columns = ["", "top-1", "top-5"]
            out.append((f"Own caption among {found['among']}, by TMA", columns, [guess, *tops]))
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
        f"Reconstruction on {figures['reconstructed_clips']} {figures['split']} clips, mm (lower is better); "
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
