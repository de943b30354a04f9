"""Evaluation: reconstruction, retrieval, generation on the test split, each beside reference baselines."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of
from motionloom.pipeline.contract.stage import (
    FACE_ALIGNMENT,
    GENERATOR,
    Every,
    NotThereError,
    StageContext,
    register,
)
from motionloom.pipeline.contract.units import Arrays, Row, as_rows
from motionloom.pipeline.evaluation.clip_metrics import Performance, clip_figures, measure_clip, metrics_of
from motionloom.pipeline.evaluation.diagnosis import Diagnosis
from motionloom.pipeline.evaluation.figures import (
    MODEL,
    NEAREST_LABELS,
    NEAREST_WORDS,
    RECORDED,
    STILL,
    THROUGH,
    TRAINING,
    Fact,
    Figure,
    FigureFile,
)
from motionloom.pipeline.evaluation.latent_metrics import (
    GUO_BATCH,
    judged_figures,
    reconstructed_figures,
    unit_length,
)
from motionloom.pipeline.evaluation.movement import Features, all_features, movement_figures
from motionloom.pipeline.evaluation.reconstruction import clip_error_figures, face_figures
from motionloom.pipeline.evaluation.reference_baselines import (
    by_nearest_caption,
    by_nearest_labels,
    mean_poses,
)
from motionloom.pipeline.evaluation.truth import Truth, digest_of, spread_any, truth_of
from motionloom.pipeline.stages.results.evaluate_units import (
    CAPTIONS,
    CLIP,
    DISTANCES,
    FACE,
    JOINTS,
    LATENT,
    MOVEMENT,
    EvaluateConfig,
    EvaluationUnits,
)
from motionloom.pipeline.stages.results.evaluation import EvaluationStage
from motionloom.pipeline.store.networks import LoadedTma

_NAMES = {"tma": "TMA", "evaluator": "the evaluator", "face_evaluator": "the face evaluator"}


class EvaluateStage(EvaluationStage):
    """Reconstruction, retrieval and generation on the test split."""

    name = "evaluate"
    summary = "figures on the test split"
    config = EvaluateConfig
    takes = (
        "data", "tokenizer?", "face_tokenizer?: tokenizer", "tma?", "evaluator?",
        f"face_evaluator?: {FACE_ALIGNMENT}",
        Every("generators", GENERATOR),
    )  # fmt: skip

    def external(self, config: EvaluateConfig) -> dict[str, str]:
        """Checksum of the model whose vertices are measured."""
        if config.face_model is None:
            return {}
        path = config.face_model.expanduser()
        if not path.is_file():
            raise NotThereError(f"{path}: no such model file", "face_model")
        return {path.name: sha256_of(path)}

    def evaluation(self, context: StageContext) -> _Evaluation:
        return _Evaluation(context)


class _Evaluation(EvaluationUnits):
    """Results of all processes."""

    def __init__(self, context: StageContext) -> None:
        super().__init__(context)
        self.diagnosis = Diagnosis(self.dataset.layout)

    def measured(self) -> FigureFile:
        """All figures, each beside its reference baselines; `cases.safetensors` is written beside them."""
        context = self.context
        split = self.dataset.split
        figures = self.reconstruction()
        if not self.truths and not figures:
            raise UserError(
                f"{self.dataset.where}: no captioned clip of split '{split}' is long enough for one group of "
                f"tokens"
            )
        if left := int((~self.said).sum()):
            rest = "are left out" if self.tokenizer is None else "are left out, except of the reconstruction"
            context.console.print(f"    {split}: {left} clips without a caption {rest}")
        if self.performs:
            made = list(context.units.read("generated", len(self.performances)))
            figures += self.by_judges(made) + self.clip_by_clip(made) + self.movement(made)
        stages = {role: context.inputs[role] for role in self.judges}
        judges = {
            role: {"stage": stage.name, "kind": stage.kind.name, "sha256": self._weights(role)}
            for role, stage in stages.items()
        }
        about = self.about(self.bundle) | {"judges": judges}
        return FigureFile("evaluate", tuple(figures), about, self.diagnosis.write(context.folder))

    def _weights(self, role: str) -> str:
        return sha256_of(self.context.input(role) / "model.safetensors")

    @cached_property
    def protocol(self) -> dict[str, Fact]:
        """Return the settings behind figures of generated motion, but for the seed."""
        config = self.config
        assert self.bundle is not None
        return {
            "split": self.dataset.split,
            "clips": len(self.truths),
            "clips_sha256": digest_of(self.truths),
            "caption": "the first about the whole clip, else the first",
            "lengths": config.lengths,
            **self.drawn_as(self.bundle),
        }

    def reconstruction(self) -> list[Figure]:
        if self.tokenizer is None:
            return []
        found = list(self.context.units.read("reconstructed", len(self.slices)))
        if not found:
            return []
        protocol: dict[str, Fact] = {
            "split": self.dataset.split, "clips": len(self.shown), "clips_sha256": digest_of(self.shown)
        }  # fmt: skip
        rows = [row for table in found for row in as_rows(table, JOINTS)]
        out = clip_error_figures(rows, self.tokenizer.net.bits_per_second, protocol)
        out += face_figures([row for table in found for row in as_rows(table, FACE)], protocol)
        for role, judge in self.judges.items():
            latents = [table[LATENT[role]] for table in found if LATENT[role] in table]
            shown = judge.judged(self.shown)
            if latents:
                out += reconstructed_figures(
                    role,
                    _NAMES[role],
                    judge.recorded(shown),
                    torch.from_numpy(np.concatenate(latents)),
                    judge.recorded(judge.judged(self.others)[: len(shown)]),
                    judge.texts(shown) if self.shown is self.truths else None,
                    {**protocol, "judge": self._weights(role)},
                    size=min(self.config.size, GUO_BATCH),
                    repeats=self.config.repeats,
                    seed=self.context.seed,
                )
        distances = np.concatenate([table[DISTANCES] for table in found])
        self.diagnosis.take_distances(distances, [len(truth.features) for truth in self.shown])
        self.diagnosis.take("reconstruction", self.shown, found, [row["mpjpe"] for row in rows])
        return out

    def by_judges(self, made: Sequence[Arrays]) -> list[Figure]:
        """Figures by the latents of each judge."""
        config = self.config
        out = list[Figure]()
        for role, judge in self.performed_by.items():
            truths = judge.judged(self.truths)
            others = judge.judged(self.others)
            nearest = {} if judge.of_faces else self._nearest_captions
            latents = judge.latents(truths, self._latents(made, role), others, nearest)
            if not judge.of_faces:
                apart = unit_length(latents.text) - unit_length(latents.made[0])
                first = self._repeats(made)[0]
                self.diagnosis.take("generated", truths, first, apart.norm(dim=-1).tolist())
            out += judged_figures(
                role,
                _NAMES[role],
                latents,
                judge.words(truths),
                {**self.protocol, "clips": len(truths), "judge": self._weights(role)},
                size=config.size if role == "tma" else min(config.size, GUO_BATCH),
                among=config.among,
                seed=self.context.seed,
            )
        return out

    def clip_by_clip(self, made: Sequence[Arrays]) -> list[Figure]:
        """Figures of single motions, beside recorded motion, as many training clips and the mean pose."""
        fps = self.dataset.layout.fps
        clips = {RECORDED: self.truths, **self._nearest_captions}
        baselines = {row: [(t.joints, t.face) for t in found] for row, found in clips.items()}
        baselines[STILL] = [(joints, None) for joints in self._still]
        if len(self.others) >= len(self.truths):
            baselines[TRAINING] = [(t.joints, None) for t in self.others[: len(self.truths)]]
        rows = {MODEL: [self._rows(some) for some in self._repeats(made)]}
        if self.shown is self.truths:
            rows[THROUGH] = [self._rows(list(self.context.units.read("reconstructed", len(self.slices))))]
        for row, motions in baselines.items():
            performances = [
                Performance(joints, t.joints, fps, face, t.truth)
                for (joints, face), t in zip(motions, self.truths, strict=True)
            ]
            rows[row] = [[measure_clip(metrics_of("captions"), one) for one in performances]]
        return clip_figures(metrics_of("captions"), rows, self.protocol)

    def movement(self, made: Sequence[Arrays]) -> list[Figure]:
        """Figures of kinetic and geometric features."""
        fps = self.dataset.layout.fps
        real = all_features((t.joints for t in self.truths), fps)
        others = all_features((t.joints for t in self.others[: len(self.truths)]), fps)
        drawn: list[Features] = [
            {kind: np.concatenate([table[MOVEMENT + kind] for table in some]) for kind in ("k", "m")}
            for some in self._repeats(made)
        ]
        rows = {MODEL: drawn, RECORDED: [real], TRAINING: [others], STILL: [all_features(self._still, fps)]}
        for row, found in self._nearest_captions.items():
            rows[row] = [all_features((t.joints for t in found), fps)]
        return movement_figures(self.reference(CAPTIONS), real, rows, self.protocol)

    @cached_property
    def others(self) -> list[Truth]:
        """As many training clips as are judged."""
        count = max(len(self.truths), len(self.shown))
        return [truth_of(self.train, i) for i in spread_any(self.train, count)]

    @cached_property
    def _nearest_captions(self) -> dict[str, list[Truth]]:
        """The training clip that each lookup finds for every caption."""
        models = [judge.motions for judge in self.judges.values()]
        texts = [model.given["text"] for model in models if isinstance(model, LoadedTma)]
        caches = [text.cache for text in texts if not text.exported]
        found = {
            NEAREST_WORDS: by_nearest_caption(self.train, self.truths, caches),
            NEAREST_LABELS: by_nearest_labels(self.train, self.truths),
        }
        return {row: clips for row, clips in found.items() if clips}

    @cached_property
    def _still(self) -> list[NDArray[np.float64]]:
        lengths = [len(t.joints) for t in self.truths]
        return mean_poses([t.joints for t in self.others], self.dataset.layout.fps, lengths)

    def _repeats(self, made: Sequence[Arrays]) -> list[Sequence[Arrays]]:
        """Return the generated motions, draw by draw."""
        found = list(zip(self.performances, made, strict=True))
        return [[table for (own, _), table in found if own == draw] for draw in range(self.draws)]

    def _rows(self, some: Sequence[Arrays]) -> list[Row]:
        return [row for table in some for row in as_rows(table, CLIP)]

    def _latents(self, made: Sequence[Arrays], role: str) -> list[torch.Tensor]:
        """A judge's latents [n, Z] of all clips, once for each repeat."""
        name = LATENT[role]
        return [
            torch.from_numpy(np.concatenate([table[name] for table in some if name in table]))
            for some in self._repeats(made)
        ]


register(EvaluateStage())
