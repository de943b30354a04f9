"""Evaluation: reconstruction, retrieval, generation on the test split, each beside its trivial answer."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
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
from motionloom.pipeline.contract.units import Arrays, as_rows, as_table, even_slices
from motionloom.pipeline.evaluation.cases import write_cases
from motionloom.pipeline.evaluation.detail_rows import detail_showings
from motionloom.pipeline.evaluation.details import Details
from motionloom.pipeline.evaluation.figure_rows import figure_rows
from motionloom.pipeline.evaluation.figures import bodily, embed_motions, obeyed, shares
from motionloom.pipeline.evaluation.judges import Judge
from motionloom.pipeline.evaluation.nearest import NearestClip
from motionloom.pipeline.evaluation.reconstruction import (
    clip_errors,
    face_errors,
    mean_errors,
    mean_face_errors,
)
from motionloom.pipeline.evaluation.tables import plain, print_tables
from motionloom.pipeline.evaluation.text_motion import distribution, matching, retrieval
from motionloom.pipeline.evaluation.truth import Truth, digest_of, drawn, has_caption, spread_any, truth_of
from motionloom.pipeline.evaluation.versions import EVALUATE
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.driven import bundle_driven_by
from motionloom.pipeline.stages.bar import bar
from motionloom.pipeline.store.evaluator import LoadedEvaluator
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.networks import TrainedTokenizer

_FILE = "metrics.json"
_RECONSTRUCTED, _GENERATED = 16, 64
"""Clips at a time, at most."""
_JOINTS, _FACE, _OBEYED, _PHYSICS, _MOTION = "joints/", "face/", "obeyed/", "physics/", "motion/"
"""Begin the names of what is measured of a clip, or made for it."""
_LATENT = {"tma": "latent", "evaluator": "latent_evaluator"}
"""Role of a judge -> name of its latents of what was generated."""


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
    takes = (
        "data", "tokenizer?", "face_tokenizer?: tokenizer", "tma?", "evaluator?",
        Every("generators", GENERATOR),
    )  # fmt: skip
    shares = True
    version = EVALUATE

    def gives(self, config: Any) -> frozenset[str]:
        """Its tables."""
        return frozenset({"figures", SHOWING})

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


class _Evaluation:
    """What one evaluation measures; its clips are the same in every process."""

    def __init__(self, context: StageContext) -> None:
        self.context, self.config = context, context.config
        self.tokenizer: TrainedTokenizer | None = context.given.get("tokenizer")
        makers = context.every("generators")
        # Without generators a tokenizer alone is measured (`generators: []`).
        self.bundle: Bundle | None = None
        if makers:
            self.bundle = bundle_driven_by("text", makers, context.shelf) or Bundle(makers, context.shelf)
        self.dataset = context.given["data"].held_out(prefer="test")
        self.details = Details(self.dataset.layout, EVALUATE)
        self.judges = self._judges()
        if self.tokenizer is not None:
            unit = self.tokenizer.net.group_frames
        elif self.bundle is not None:
            unit = self.bundle.generator.unit_frames
        else:
            raise UserError(
                f"stage '{context.name}': no tokenizer and no generator to evaluate; name one in its inputs"
            )
        self.said = has_caption(self.dataset)
        chosen = drawn(self.dataset, self.config.clips) if self.said.any() else []
        self.truths = self._truths(chosen, unit)
        """Clips with a caption, which is performed."""
        self.shown: list[Truth] = []
        """Clips that are reconstructed."""
        if self.tokenizer is not None:
            every = self.said.all()
            self.shown = (
                self.truths if every else self._truths(spread_any(self.dataset, self.config.clips), unit)
            )

    def _judges(self) -> dict[str, Judge]:
        """TMA and the evaluator, those that are there, by role."""
        given, out = self.context.given, dict[str, Judge]()
        if "tma" in given:
            out["tma"] = Judge.tma(given["tma"])
        if "evaluator" in given:
            found: LoadedEvaluator = given["evaluator"]
            found.require_layout(self.dataset.layout, self.context.inputs["evaluator"].name)
            out["evaluator"] = Judge.evaluator(found)
        return out

    @property
    def performs(self) -> bool:
        """Whether motions are made for captions."""
        bundle = self.bundle
        return bool(self.truths) and bundle is not None and "text" in bundle.generator.modalities

    @cached_property
    def slices(self) -> list[slice]:
        """Clips that are reconstructed together."""
        return even_slices(len(self.shown), _RECONSTRUCTED)

    @cached_property
    def performances(self) -> list[tuple[int, slice]]:
        """Repeats and clips whose captions are performed together."""
        pieces = even_slices(len(self.truths), _GENERATED) if self.performs else []
        return [(repeat, piece) for repeat in range(self.config.repeats) for piece in pieces]

    def share(self) -> None:
        """This process's share of all that is made clip by clip."""
        if self.performs:
            for judge in self.judges.values():
                judge.texts(self.truths)  # captions that it cannot read are refused before anything is made
        units, sizes = self.context.units, [piece.stop - piece.start for piece in self.slices]
        with bar(self.context.console) as progress:
            task = progress.add_task("reconstructing", total=units.mine(sizes), note="")
            units.make(
                "reconstructed",
                len(sizes),
                lambda k: self.reconstruct(self.shown[self.slices[k]]),
                lambda k: progress.advance(task, sizes[k]),
            )
        made = [piece.stop - piece.start for _, piece in self.performances]
        with bar(self.context.console) as progress:
            another = progress.add_task("generating", total=units.mine(made), note="")
            units.make(
                "generated",
                len(made),
                lambda k: self.perform(*self.performances[k]),
                lambda k: progress.advance(another, made[k]),
            )

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
                clips = [row for table in found for row in as_rows(table, _JOINTS)]
                figures["reconstruction_mm"] = mean_errors(clips)
                faces = mean_face_errors(row for table in found for row in as_rows(table, _FACE))
                figures |= {"reconstruction_face": faces} if faces else {}
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
        figures |= self.by_judges(made)
        fps = dataset.layout.fps
        figures["physics"] = {
            "recorded": shares(bodily(t.joints, fps) for t in self.truths),
            "generated": shares(row for table in made for row in as_rows(table, _PHYSICS)),
        }
        if any(t.truth for t in self.truths):
            self.details.performed(self.truths, self._first(made))
            figures["agreement_with_caption"] = {
                "truth": shares(obeyed(t, t.joints, t.face, fps) for t in self.truths),
                "generated": shares(row for table in made for row in as_rows(table, _OBEYED)),
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
        return facts

    def _truths(self, chosen: Sequence[int], unit: int) -> list[Truth]:
        """The clips `chosen` that are long enough for one group of tokens."""
        found = [truth_of(self.dataset, i) for i in sorted(chosen)]
        return [truth for truth in found if len(truth.features) >= unit]

    @cached_property
    def _nearest(self) -> NearestClip:
        return NearestClip(self.context.given["data"].split("train"))

    def reconstruct(self, truths: Sequence[Truth]) -> Arrays:
        """Errors of clips through the tokenizer, and of expressions where a tokenizer models them."""
        tokenizer = self.tokenizer
        assert tokenizer is not None
        out = as_table([clip_errors(tokenizer, self._nearest, truth) for truth in truths], _JOINTS)
        faces = self.context.given.get("face_tokenizer", tokenizer)
        if faces.layout.has("face") and faces.net.part in ("face", "all"):
            out |= as_table([face_errors(faces, truth) for truth in truths], _FACE)
        return out

    def perform(self, repeat: int, piece: slice) -> Arrays:
        """Motions for the captions of some clips, as latents and by whether they do what is said."""
        assert self.bundle is not None
        truths, fps = self.truths[piece], self.dataset.layout.fps
        recorded = [len(t.features) / fps for t in truths]
        motions = self.bundle.generate(
            [t.caption for t in truths],
            face=[t.face_caption for t in truths],
            seconds=recorded if self.config.lengths == "recorded" else None,
            seed=self.context.seed + 7919 * (repeat + 1) + piece.start,
            sampling=self.config.sampling,
        )
        rows = [obeyed(t, m.joints, m.face, fps) for t, m in zip(truths, motions, strict=True)]
        out = as_table(rows, _OBEYED) | as_table([bodily(m.joints, fps) for m in motions], _PHYSICS)
        if repeat == 0:
            out |= {f"{_MOTION}{number:03d}": m.joints for number, m in enumerate(motions)}
        for role, judge in self.judges.items():
            out[_LATENT[role]] = embed_motions(judge.motions, [m.features for m in motions]).numpy()
        return out

    def _first(self, made: Sequence[Arrays]) -> list[NDArray[np.float64]]:
        """Joints [T, N, 3] of the first repeat."""
        return [table[name] for table in made for name in sorted(table) if name.startswith(_MOTION)]

    def _repeats(self, made: Sequence[Arrays], role: str) -> list[NDArray[np.float32]]:
        """A judge's latents [n, Z] of all clips, once for each repeat."""
        each = len(self.performances) // self.config.repeats
        return [
            np.concatenate([table[_LATENT[role]] for table in made[first : first + each]])
            for first in range(0, len(made), each)
        ]

    def by_judges(self, made: Sequence[Arrays]) -> dict[str, Any]:
        """Figures by the latents of each judge, beside as many training clips and the mean pose."""
        config, seed, truths, out = self.config, self.context.seed, self.truths, dict[str, Any]()
        train = self.context.given["data"].split("train") if self.judges else None
        others = [] if train is None else [truth_of(train, i) for i in spread_any(train, len(truths))]
        for role, judge in self.judges.items():
            latents = judge.latents(truths, [torch.from_numpy(z) for z in self._repeats(made, role)], others)
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
                out["by_evaluator"] = {"matching": found, "distribution": spread}
        return out
