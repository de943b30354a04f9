"""Evaluation: reconstruction, retrieval, generation on the test split, each beside its trivial answer."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.showing import FigureTable, Showing
from motionloom.pipeline.contract.stage import (
    FACE_ALIGNMENT,
    GENERATOR,
    SHOWING,
    Every,
    Finished,
    Given,
    StageContext,
    StageKind,
)
from motionloom.pipeline.contract.units import Arrays, as_rows
from motionloom.pipeline.evaluation.cases import write_cases
from motionloom.pipeline.evaluation.dance_answers import mean_poses
from motionloom.pipeline.evaluation.detail_rows import detail_showings
from motionloom.pipeline.evaluation.figure_rows import figure_rows
from motionloom.pipeline.evaluation.figures import bodily, obeyed, shares
from motionloom.pipeline.evaluation.paired import paired_figures
from motionloom.pipeline.evaluation.reconstruction import (
    mean_errors,
    mean_face_errors,
)
from motionloom.pipeline.evaluation.tables import plain, print_tables
from motionloom.pipeline.evaluation.text_motion import distribution, matching, reconstructed, retrieval
from motionloom.pipeline.evaluation.truth import (
    Truth,
    digest_of,
    spread_any,
    truth_of,
)
from motionloom.pipeline.evaluation.versions import EVALUATE
from motionloom.pipeline.stages.evaluate_units import (
    FACE,
    JOINTS,
    LATENT,
    MOTION,
    MOVEMENT,
    OBEYED,
    PHYSICS,
    POSITION,
    EvaluateConfig,
    EvaluationUnits,
)
from motionloom.pipeline.store.files import write_json

_FILE = "metrics.json"


class EvaluateStage(StageKind):
    """Reconstruction, retrieval and generation on the test split."""

    name = "evaluate"
    summary = "figures on the test split"
    config = EvaluateConfig
    takes = (
        "data", "tokenizer?", "face_tokenizer?: tokenizer", "tma?", "evaluator?",
        f"face_evaluator?: {FACE_ALIGNMENT}",
        Every("generators", GENERATOR),
    )  # fmt: skip
    shares = True
    version = EVALUATE

    def gives(self, config: Any) -> frozenset[str]:
        """Its tables."""
        return frozenset({"figures", SHOWING})

    def external(self, config: Any) -> dict[str, str]:
        """Checksum of the head whose vertices are measured."""
        path = config.face_basis
        if path is None:
            return {}
        if not path.is_file():
            raise UserError(f"evaluate: face_basis {path}: no such file")
        return {path.name: sha256_of(path)}

    def share(self, context: StageContext) -> None:
        """Reconstruct, generate and measure this process's share of the clips."""
        _Evaluation(context).share()

    def run(self, context: StageContext) -> None:
        """Write `metrics.json` and print it as tables."""
        evaluation = _Evaluation(context)
        figures = plain(evaluation.figures() | evaluation.details.figures())
        write_cases(context.folder, evaluation.details.cases)
        write_json(context.folder / _FILE, figures)
        print_tables(context.console, figure_rows(figures))
        context.units.clear()

    def show(self, stage: Finished, given: Given) -> list[Showing]:
        """The tables."""
        figures = json.loads((stage.folder / _FILE).read_text())
        tables = [FigureTable(title, columns, rows) for title, columns, rows in figure_rows(figures)]
        return [*tables, *detail_showings(stage.folder, figures)]


class _Evaluation(EvaluationUnits):
    """What is read from what all processes have made."""

    def figures(self) -> dict[str, Any]:
        """All figures, each beside its trivial answer."""
        dataset, context = self.dataset, self.context
        figures: dict[str, Any] = {"split": dataset.split, "clips": len(self.truths)}
        if self.tokenizer is not None:
            figures["bits_per_second"] = self.tokenizer.net.bits_per_second
            figures["reconstructed_clips"] = len(self.shown)
            figures["reconstructed_sha256"] = digest_of(self.shown)
            found = list(context.units.read("reconstructed", len(self.slices)))
            if found:
                clips = [row for table in found for row in as_rows(table, JOINTS)]
                figures["reconstruction_mm"] = mean_errors(clips)
                faces = mean_face_errors(row for table in found for row in as_rows(table, FACE))
                figures |= {"reconstruction_face": faces} if faces else {}
                figures |= self.reconstructed(found)
                self.details.reconstructed(self.tokenizer, self.shown)
        if not self.truths and "reconstruction_mm" not in figures:
            raise UserError(
                f"{dataset.where}: no captioned clip of split '{dataset.split}' is long enough for one group "
                f"of tokens"
            )
        if left := int((~self.said).sum()):
            rest = "are left out" if self.tokenizer is None else "are left out, except of the reconstruction"
            context.console.print(f"    {dataset.split}: {left} clips without a caption {rest}")
        if not self.performs:
            return figures
        figures["protocol"] = self.protocol() | {"clips_sha256": digest_of(self.truths)}
        made = list(context.units.read("generated", len(self.performances)))
        figures |= self.by_judges(made) | self.beside_recorded(made)
        fps = dataset.layout.fps
        figures["physics"] = {
            "recorded": shares(bodily(t.joints, fps) for t in self.truths),
            "generated": shares(row for table in made for row in as_rows(table, PHYSICS)),
        }
        if any(t.truth for t in self.truths):
            self.details.performed(self.truths, self._first(made))
            figures["agreement_with_caption"] = {
                "truth": shares(obeyed(t, t.joints, t.face, fps) for t in self.truths),
                "generated": shares(row for table in made for row in as_rows(table, OBEYED)),
            }
        return figures

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
        if "tma" in self.judges:
            weights = sha256_of(context.input("tma") / "model.safetensors")
            facts["evaluator"] = {"stage": context.inputs["tma"].name, "sha256": weights}
        if "evaluator" in self.judges:
            stage = context.inputs["evaluator"]
            named = {"stage": stage.name, "kind": stage.kind.name}
            named["sha256"] = sha256_of(stage.folder / "model.safetensors")
            facts["by_evaluator"] = named | context.given["evaluator"].facts
        if "face_evaluator" in self.judges:
            weights = sha256_of(context.input("face_evaluator") / "model.safetensors")
            facts["by_face_evaluator"] = {"stage": context.inputs["face_evaluator"].name, "sha256": weights}
        return facts

    def _first(self, made: Sequence[Arrays]) -> list[NDArray[np.float64]]:
        """Joints [T, N, 3] of the first repeat."""
        return [table[name] for table in made for name in sorted(table) if name.startswith(MOTION)]

    def _repeats(self, made: Sequence[Arrays], role: str) -> list[NDArray[np.float32]]:
        """A judge's latents [n, Z] of all clips, once for each repeat."""
        each = len(self.performances) // self.config.repeats
        return [
            np.concatenate([t[LATENT[role]] for t in made[first : first + each] if LATENT[role] in t])
            for first in range(0, len(made), each)
        ]

    def by_judges(self, made: Sequence[Arrays]) -> dict[str, Any]:
        """Figures by the latents of each judge, beside as many training clips and the mean pose."""
        config, seed, truths, out = self.config, self.context.seed, self.truths, dict[str, Any]()
        for role, judge in self.performed_by.items():
            drawn_by = [torch.from_numpy(z) for z in self._repeats(made, role)]
            others = self.judged(judge, self.others)
            latents = judge.latents(self.judged(judge, truths), drawn_by, others)
            spread, repeats = distribution(latents, seed=seed), config.repeats
            if role == "tma":
                self.details.judged(latents, truths, self._first(made))
                words = [t.caption for t in truths]
                found = retrieval(
                    latents, words, size=config.size, among=config.among, repeats=repeats, seed=seed
                )
                out |= {"retrieval": found, "distribution": spread}
            else:
                found = matching(latents, size=config.size, repeats=repeats, seed=seed)
                out[f"by_{role}"] = {"matching": found, "distribution": spread}
        return out

    @cached_property
    def others(self) -> list[Truth]:
        """As many training clips as are judged."""
        train = self.context.given["data"].split("train")
        count = max(len(self.truths), len(self.shown))
        return [truth_of(train, i) for i in spread_any(train, count)]

    def reconstructed(self, found: Sequence[Arrays]) -> dict[str, Any]:
        """By each judge, what a tokenizer does to the latents."""
        out, config = {}, self.config
        for role, judge in self.judges.items():
            rows = [table[LATENT[role]] for table in found if LATENT[role] in table]
            shown = self.judged(judge, self.shown)
            if rows:
                out[role] = reconstructed(
                    judge.recorded(shown),
                    torch.from_numpy(np.concatenate(rows)),
                    judge.recorded(self.judged(judge, self.others)[: len(shown)]),
                    judge.texts(shown) if self.shown is self.truths else None,
                    size=config.size,
                    repeats=config.repeats,
                    seed=self.context.seed,
                )
        return {"reconstruction_latents": out} if out else {}

    def beside_recorded(self, made: Sequence[Arrays]) -> dict[str, Any]:
        """Distances and features of what was generated, beside what was recorded for the same captions."""
        each, fps = len(self.performances) // self.config.repeats, self.dataset.layout.fps
        repeats = []
        for first in range(0, len(made), each):
            some = made[first : first + each]
            features = {kind: np.concatenate([t[MOVEMENT + kind] for t in some]) for kind in ("k", "m")}
            repeats.append(([row for t in some for row in as_rows(t, POSITION)], features))
        real, others = ([t.joints for t in truths] for truths in (self.truths, self.others))
        still = mean_poses(others, fps, [len(joints) for joints in real])
        return paired_figures(real, others[: len(real)], still, repeats, fps)
