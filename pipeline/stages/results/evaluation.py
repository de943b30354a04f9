"""Base of the stages that evaluate: their work is shared, their figures are written and shown."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.progress import Meter
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.pipeline.contract.showing import FigureTable, Showing
from motionloom.pipeline.contract.stage import (
    SHOWING,
    CompletedStage,
    Inputs,
    StageCache,
    StageContext,
    StageKind,
)
from motionloom.pipeline.contract.units import Arrays, even_slices
from motionloom.pipeline.evaluation.clip_metrics import CLIP_METRICS
from motionloom.pipeline.evaluation.diagnosis import showings
from motionloom.pipeline.evaluation.figures import (
    FILE_NAME,
    Fact,
    FigureFile,
    facts,
    figure_tables,
    print_summary,
)
from motionloom.pipeline.evaluation.movement import Features, all_features
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.stages.results.report_parts import draw_evaluations

PAGE = "figures.html"
_REFERENCE = 64
"""Motions at a time whose features are taken."""


class EvaluationStage(StageKind):
    """A kind of stage that writes figures."""

    shares = True
    offers = frozenset({"figures", SHOWING})

    def modules(self, config: Any) -> Iterable[str]:
        return [*super().modules(config), *(one.measure.__module__ for one in CLIP_METRICS.values())]

    @abstractmethod
    def evaluation(self, context: StageContext) -> Evaluation:
        """The evaluation of one run."""

    def share(self, context: StageContext) -> None:
        """Make and measure this process's share of the clips."""
        self.evaluation(context).share()

    def run(self, context: StageContext) -> None:
        """Write `metrics.json` and a page of its tables, of which a line each is printed."""
        found = self.evaluation(context).measured()
        found.write(context.folder / FILE_NAME)
        page = Page(f"Figures of {context.recipe}", context.name)
        draw_evaluations(page, _showings(context.folder, found))
        page.write(context.folder / PAGE)
        print_summary(found.figures, context.console)
        text = f"    all {len(found.figures)} figures: {context.folder / PAGE}"
        context.console.print(text, markup=False, soft_wrap=True)
        context.units.clear()

    def show(self, stage: CompletedStage, given: Inputs) -> list[Showing]:
        """The tables, and where the model errs."""
        return _showings(stage.folder, FigureFile.read(stage.folder / FILE_NAME))


def _showings(folder: Path, found: FigureFile) -> list[Showing]:
    tables = [FigureTable(*table) for table in figure_tables(found.figures)]
    return [*tables, *showings(folder, found.details)]


class Evaluation:
    """One evaluation; the clips are the same in every process."""

    def __init__(self, context: StageContext) -> None:
        self.context = context
        self.config = context.config
        data = context.given["data"]
        self.dataset: ClipDataset = data.held_out(prefer="test")
        self.train: ClipDataset = data.split("train")

    def share(self) -> None:
        """Make this process's share of what is made clip by clip; nothing where one process makes all."""

    @abstractmethod
    def measured(self) -> FigureFile:
        """The figures, from what all processes have made."""

    @property
    def draws(self) -> int:
        """Motions drawn for each clip."""
        return int(self.config.repeats * self.config.decodings)

    def in_turn(self, pieces: Sequence[slice]) -> list[tuple[int, slice]]:
        """Draws and clips in the order in which they are made: all decodings of the same tokens in a row."""
        nested = self.config.decodings
        turns = [range(first, first + nested) for first in range(0, self.draws, nested)]
        return [(draw, piece) for turn in turns for piece in pieces for draw in turn]

    def seeds(self, draw: int, first: int) -> tuple[int, int | None]:
        """Return the seeds of a draw's tokens from clip `first` on, or of the noise of repeated decodings."""
        turn, decoding = divmod(draw, self.config.decodings)
        seed = self.context.seed + 7919 * (turn + 1) + first
        return seed, None if self.config.decodings == 1 else seed + 104_729 * (decoding + 1)

    def drawn_as(self, bundle: Bundle) -> dict[str, Fact]:
        """Return sampling settings and number of draws, for the protocol of the figures."""
        config = self.config
        nested = {} if config.decodings == 1 else {"decodings": config.decodings}
        if nested and "sampler" not in bundle.generator.settings:
            raise UserError(
                f"stage '{self.context.name}': decodings {config.decodings}, but '{bundle.main.name}' has no "
                f"diffusion decoder; set decodings to 1"
            )
        return facts({"repeats": config.repeats, **nested, "sampling": bundle.in_effect(config.sampling)})

    def about(self, bundle: Bundle | None) -> dict[str, Any]:
        """Return the evaluated stage, split and generators."""
        made_by = dict[str, CompletedStage | None]()
        if bundle is not None:
            face = bundle.choose_face(self.config.sampling.face_model)
            made_by = {"generator": bundle.main, "face_generator": face}
        return {
            "stage": self.context.name,
            "split": self.dataset.split,
            "seed": self.context.seed,
            "made_by": {role: stage.name for role, stage in made_by.items() if stage is not None},
        }

    def make(self, name: str, what: str, sizes: Sequence[int], result: Callable[[int], Arrays]) -> None:
        """This process's share of units called `name`, with so many clips each."""
        units = self.context.units
        with Meter(what, units.mine(sizes), console=self.context.console) as meter:
            units.make(name, len(sizes), result, lambda k: meter.advance(sizes[k]))

    def make_reference(self, member: str) -> None:
        """This process's share of the features of all motions whose clips have `member`."""
        motions = self._reference(member)
        slices = even_slices(len(motions), _REFERENCE)

        def features(number: int) -> Arrays:
            layout = self.dataset.layout
            some = motions[slices[number]]
            bodies = (np.asarray(data.motion(k))[:, layout.part("bodyhand")] for data, k in some)
            return dict(all_features((joints_of(x, layout) for x in bodies), layout.fps))

        self.make("reference", "features of all motions", [s.stop - s.start for s in slices], features)

    def reference(self, member: str) -> Features:
        """Return all processes' results: features [n, F]."""
        count = len(even_slices(len(self._reference(member)), _REFERENCE))
        parts = list(self.context.units.read("reference", count))
        return {kind: np.concatenate([part[kind] for part in parts]) for kind in parts[0]}

    def _reference(self, member: str) -> list[tuple[ClipDataset, int]]:
        return [
            (dataset, index)
            for dataset in (self.train, self.dataset)
            for index in np.flatnonzero(dataset.has(member)).tolist()
        ]


def bundle_driven_by(
    modality: str, stages: Sequence[CompletedStage], stage_cache: StageCache
) -> Bundle | None:
    """Return the first generator of body motion that takes `modality`, and face generators, or None."""
    bundle = Bundle(stages, stage_cache)
    faces = [stage for stage in stages if bundle.generator_of(stage).part == "face"]
    for stage in stages:
        maker = bundle.generator_of(stage)
        if maker.part != "face" and modality in maker.modalities:
            # A face generator that is not conditioned on it would have nothing to go by.
            fitting = [face for face in faces if modality in bundle.generator_of(face).modalities]
            return Bundle([stage, *fitting], stage_cache)
    return None
