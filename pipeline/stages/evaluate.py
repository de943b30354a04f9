"""Evaluation: reconstruction, retrieval, generation on the test split, each beside its trivial answer."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import normalize

from motionloom.datasets.schema import UserError
from motionloom.models.metrics.dance_choice import accuracy_among
from motionloom.models.metrics.retrieval import matching_score
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
from motionloom.pipeline.evaluation.figure_rows import figure_rows
from motionloom.pipeline.evaluation.figures import (
    Interval,
    chance,
    embed_motions,
    retrieval_figures,
    truth_agreement,
)
from motionloom.pipeline.evaluation.reconstruction import reconstruction_figures
from motionloom.pipeline.evaluation.tables import plain, print_tables
from motionloom.pipeline.evaluation.truth import Truth, drawn, has_caption, spread_any, truth_of
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
    takes = ("data", "tokenizer?", "tma?", Every("generators", GENERATOR))
    version = 5  # the papers' definitions, clips drawn as they come; TMA reads captions by its own encoder

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
        chosen = drawn(dataset, self.config.clips) if said.any() else []
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
        """Recall among `size` and the matching score, of real and of generated motion.

        Clips are those drawn, as in the paper, so two of a batch may have one caption; the same of clips with
        different captions alone stands beside it. TMA reads captions by the encoder that it was trained with,
        whatever the generator reads.
        """
        words = [t.caption for t in truths]
        text = tma.embed_captions(words, tma.given["text"].cache)
        real = embed_motions(tma, [t.features for t in truths], [t.present for t in truths])
        made = [embed_motions(tma, [g.features for g in motions]) for motions in generated]
        # A caption that says the same as the own one is no wrong answer.
        same = torch.tensor([[one == other for other in words] for one in words])
        among = min(self.config.among, 1 + int((~same).sum(1).min()))
        first = sorted({caption: row for row, caption in reversed(list(enumerate(words)))}.values())
        out = {"among": among, **self._recalls(text, real, made)}
        if len(first) > 1:
            out["different_captions"] = self._recalls(text[first], real[first], [m[first] for m in made])
        if among > 1:
            for name, latents in (("real", [real]), ("generated", made)):
                rows = [
                    accuracy_among(m, text, candidates=among, same=same, seed=self.context.seed)
                    for m in latents
                ]
                out[name] |= {key: Interval.of([row[key] for row in rows]) for key in rows[0]}
        return out

    def _recalls(self, text: Tensor, real: Tensor, made: Sequence[Tensor]) -> dict[str, Any]:
        """Recall both ways, TMA-Matching score (of latents of length 1, the paper's scale) and the distance
        of the latents as they are, by row-aligned latents [n, Z].
        """
        config, seed = self.config, self.context.seed
        size = min(config.size, len(text))
        known = retrieval_figures(text, real, size=size, repeats=max(config.repeats, 5), seed=seed)
        rows: dict[str, list[float]] = {}
        for repeat, latent in enumerate(made):
            once = retrieval_figures(text, latent, size=size, repeats=1, seed=seed + repeat)
            for name, value in {**once, **_distances(text, latent)}.items():
                rows.setdefault(name, []).append(value.mean)
        return {
            "clips": len(text),
            "size": size,
            "chance": {f"r{k}": chance(k, size) for k in (1, 2, 3)},
            "real": {**known, **_distances(text, real)},
            "generated": {name: Interval.of(values) for name, values in rows.items()},
        }

    def agreement(self, truths: list[Truth], generated: list[list[GeneratedMotion]]) -> dict[str, Any]:
        """Whether motions do what their captions say, by their joints."""
        fps = self.dataset.layout.fps
        made = [(t, g.joints, g.face) for motions in generated for t, g in zip(truths, motions, strict=True)]
        return {
            "truth": truth_agreement([(t, t.joints, t.face) for t in truths], fps),
            "generated": truth_agreement(made, fps),
        }


def _distances(text: Tensor, motion: Tensor) -> dict[str, Interval]:
    """Mean distance of each text's latent from its motion's, both of length 1, and as they are."""
    unit = matching_score(normalize(text.double(), dim=-1), normalize(motion.double(), dim=-1))
    plain_distance = matching_score(text, motion)
    return {
        "matching_score": Interval(float(unit), 0.0),
        "latent_distance": Interval(float(plain_distance), 0.0),
    }
