"""Evaluation: reconstruction, retrieval, generation on the test split, each beside its trivial answer."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from pydantic import Field

from motionloom.datasets.base.files import sha256_of
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
from motionloom.pipeline.evaluation.cases import Case, generated_cases, reconstructed_cases, write_cases
from motionloom.pipeline.evaluation.confusions import measured_confusions, retrieval_confusions
from motionloom.pipeline.evaluation.detail_rows import detail_showings
from motionloom.pipeline.evaluation.figure_rows import figure_rows
from motionloom.pipeline.evaluation.figures import (
    embed_motions,
    truth_agreement,
)
from motionloom.pipeline.evaluation.joint_map import joint_map
from motionloom.pipeline.evaluation.reconstruction import face_figures, reconstruction_figures
from motionloom.pipeline.evaluation.tables import plain, print_tables
from motionloom.pipeline.evaluation.text_motion import (
    Latents,
    caption_distances,
    distribution,
    retrieval,
)
from motionloom.pipeline.evaluation.truth import Truth, digest_of, drawn, has_caption, spread_any, truth_of
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
    lengths: Literal["free", "recorded"] = "free"
    """How long generated motions are: as the generator decides, or as the recorded clip is, which is all that
    VAEs and diffusion models can do."""
    sampling: SamplingConfig = SamplingConfig()


class EvaluateStage(StageKind):
    """Reconstruction, retrieval and generation on the test split."""

    name = "evaluate"
    summary = "figures on the test split"
    config = EvaluateConfig
    takes = ("data", "tokenizer?", "face_tokenizer?: tokenizer", "tma?", Every("generators", GENERATOR))
    version = 6  # errors of each joint, confusions, worst and best cases

    def gives(self, config: Any) -> frozenset[str]:
        """Its tables."""
        return frozenset({"figures", SHOWING})

    def run(self, context: StageContext) -> None:
        """Write `metrics.json` and print it as tables."""
        evaluation = _Evaluation(context)
        figures = plain(evaluation.figures() | evaluation.details())
        write_cases(context.folder, evaluation.cases)
        write_json(context.folder / _FILE, figures)
        print_tables(context.console, figure_rows(figures))

    def show(self, stage: Finished, given: Given) -> list[Showing]:
        """The tables."""
        figures = json.loads((stage.folder / _FILE).read_text())
        tables = [FigureTable(title, columns, rows) for title, columns, rows in figure_rows(figures)]
        return [*tables, *detail_showings(stage.folder, figures)]


class _Evaluation:
    """What one evaluation measures."""

    def __init__(self, context: StageContext) -> None:
        self.context, self.config = context, context.config
        self.tokenizer: TrainedTokenizer | None = context.given.get("tokenizer")
        self.tma: LoadedTma | None = context.given.get("tma")
        makers = context.every("generators")
        self.bundle = bundle_driven_by("text", makers, context.shelf) or Bundle(makers, context.shelf)
        self.dataset = context.given["data"].held_out(prefer="test")
        self.cases: list[Case] = []
        self.confusions: list[dict[str, Any]] = []
        self.joints: dict[str, Any] = {}

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
            figures["reconstructed_sha256"] = digest_of(shown)
            if shown:
                figures["reconstruction_mm"] = reconstruction_figures(self.tokenizer, train, shown)
                figures |= self.faces(shown)
                self.keep_reconstructions(self.tokenizer, shown)
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
        figures["protocol"] = self.protocol() | {"clips_sha256": digest_of(truths)}
        generated = self.generate(truths)
        if self.tma is not None:
            figures |= self.by_tma(self.tma, truths, generated)
        if any(t.truth for t in truths):
            figures["agreement_with_caption"] = self.agreement(truths, generated)
            first = [g.joints for g in generated[0]]
            self.confusions += measured_confusions(truths, first, dataset.layout.fps)
        return figures

    def details(self) -> dict[str, Any]:
        """Errors of joints, confusions and cases, which are drawn, not listed; found beside the figures."""
        layout = self.dataset.layout
        facts = {
            "version": EvaluateStage.version,
            "fps": layout.fps,
            "skeleton": layout.skeleton.name,
            **self.joints,
        }
        cases = [case.figures() for case in self.cases]
        return facts | ({"cases": cases} if cases else {}) | {"confusions": self.confusions}

    def keep_reconstructions(self, tokenizer: TrainedTokenizer, truths: list[Truth]) -> None:
        """Keep each joint's error, and the worst and best clips."""
        found = joint_map(tokenizer, truths)
        self.joints = found.figures
        self.cases += reconstructed_cases(tokenizer, truths, found.clips)

    def keep_generated(
        self, latents: Latents, truths: list[Truth], motions: Sequence[GeneratedMotion]
    ) -> None:
        """Keep what captions are taken for, and the worst and best motions of the first repeat."""
        self.confusions += retrieval_confusions(latents, truths)
        far = caption_distances(latents.text, latents.made[0]).tolist()
        self.cases += generated_cases(truths, [motion.joints for motion in motions], far)

    def protocol(self) -> dict[str, Any]:
        """What else one has to know to get the same figures again."""
        config, context = self.config, self.context
        facts = {
            "clips": f"at most {config.clips} captioned ones, drawn at random",
            "caption": "the first about the whole clip, else the first",
            "lengths": config.lengths,
            "repeats": config.repeats,
            "seed": context.seed,
            "sampling": config.sampling.dump(),
            "generators": [stage.name for stage in context.every("generators")],
        }
        if self.tma is not None:
            weights = sha256_of(context.input("tma") / "model.safetensors")
            facts["evaluator"] = {"stage": context.inputs["tma"].name, "sha256": weights}
        return facts

    def faces(self, truths: list[Truth]) -> dict[str, Any]:
        """Reconstruction of expressions, where a tokenizer models them and a clip has one."""
        tokenizer = self.context.given.get("face_tokenizer", self.tokenizer)
        if not tokenizer.layout.has("face") or tokenizer.net.part not in ("face", "all"):
            return {}
        found = face_figures(tokenizer, truths)
        return {"reconstruction_face": found} if found else {}

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
                    seconds = [len(t.features) / self.dataset.layout.fps for t in part]
                    motions += self.bundle.generate(
                        [t.caption for t in part],
                        face_captions=[t.face_caption for t in part],
                        seconds=seconds if config.lengths == "recorded" else None,
                        seed=seed + 7919 * (repeat + 1) + start,
                        sampling=config.sampling,
                    )
                    progress.update(task, advance=len(part))
                out.append(motions)
        return out

    def by_tma(
        self, tma: LoadedTma, truths: list[Truth], generated: list[list[GeneratedMotion]]
    ) -> dict[str, Any]:
        """Retrieval and distribution by TMA's latents, beside as many training clips and the mean pose."""
        config, seed = self.config, self.context.seed
        train = self.context.given["data"].split("train")
        others = [truth_of(train, i) for i in spread_any(train, len(truths))]
        mean = tma.stats.mean[tma.layout.part(tma.part)].astype("float32")
        latents = Latents(
            text=tma.embed_captions([t.caption for t in truths], tma.given["text"].cache),
            real=embed_motions(tma, [t.features for t in truths], [t.present for t in truths]),
            made=[embed_motions(tma, [g.features for g in motions]) for motions in generated],
            others=embed_motions(tma, [t.features for t in others], [t.present for t in others]),
            still=embed_motions(tma, [np.tile(mean, (len(t.features), 1)) for t in truths]),
        )
        words = [t.caption for t in truths]
        self.keep_generated(latents, truths, generated[0])
        return {
            "retrieval": retrieval(
                latents, words, size=config.size, among=config.among, repeats=config.repeats, seed=seed
            ),
            "distribution": distribution(latents, seed=seed),
        }

    def agreement(self, truths: list[Truth], generated: list[list[GeneratedMotion]]) -> dict[str, Any]:
        """Whether motions do what their captions say, by their joints."""
        fps = self.dataset.layout.fps
        made = [(t, g.joints, g.face) for motions in generated for t, g in zip(truths, motions, strict=True)]
        return {
            "truth": truth_agreement([(t, t.joints, t.face) for t in truths], fps),
            "generated": truth_agreement(made, fps),
        }
