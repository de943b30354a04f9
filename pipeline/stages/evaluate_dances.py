"""Evaluation of dances: motion generated from held-out music, beside the ground truth and trivial answers."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from pydantic import Field

from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.models.metrics.dance_beats import DEFINITIONS
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
from motionloom.pipeline.contract.units import Arrays, even_slices
from motionloom.pipeline.evaluation.dance_answers import mean_pose, nearest_dances, random_dances
from motionloom.pipeline.evaluation.dance_figures import (
    MIN_FRAMES,
    Joints,
    Matched,
    alignment_of,
    chances,
    distribution_of,
    features_of,
    feet_of,
    multimodality_of,
    others,
    recognition_of,
    way,
)
from motionloom.pipeline.evaluation.dances import DanceClip, dances_of, require_dances
from motionloom.pipeline.evaluation.figures import Interval
from motionloom.pipeline.evaluation.tables import interval, plain, print_tables
from motionloom.pipeline.evaluation.versions import EVALUATE_DANCES
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.driven import bundle_driven_by
from motionloom.pipeline.stages.bar import bar
from motionloom.pipeline.store.files import write_json

_FILE = "dances.json"
_AT_ONCE = 16
"""Dances generated together, at most."""

KINETIC = 3 * BODY_JOINTS
"""Kinetic features of a motion."""

Group = dict[str, dict[str, float]]
"""Figures of one set of motions, by group: "beat_align", "recognition", "feet", "distribution"."""


class EvaluateDancesConfig(StageConfig):
    """How much is measured."""

    clips: int = Field(100, ge=2)
    """At most this many clips with music of the test split, different songs first."""
    repeats: int = Field(5, ge=1)
    """Dances generated to each clip's music; MultiModality needs 2."""
    seconds: float | None = Field(None, ge=1)
    """Longer clips are cut to this."""
    shuffles: int = Field(5, ge=1)
    """Other songs that each dance is compared with, for the beats of shuffled music."""
    pool: int = Field(400, ge=2)
    """Training dances that the trivial answers choose from, at most."""
    feature_fps: float = Field(60.0, gt=0)
    """Frame rate that motions are resampled to for FID, Diversity and MultiModality; published: 60."""
    sampling: SamplingConfig = SamplingConfig()


class EvaluateDancesStage(StageKind):
    """Dances to held-out music."""

    name = "evaluate_dances"
    summary = "figures of dances to held-out music"
    config = EvaluateDancesConfig
    takes = ("data", Every("generators", GENERATOR))
    shares = True
    version = EVALUATE_DANCES

    def gives(self, config: Any) -> frozenset[str]:
        """Its tables."""
        return frozenset({"figures", SHOWING})

    def share(self, context: StageContext) -> None:
        """Generate this process's share of the dances."""
        _DanceEvaluation(context).share()

    def run(self, context: StageContext) -> None:
        """Write `dances.json` and print it as tables."""
        figures = plain(_DanceEvaluation(context).figures())
        write_json(context.folder / _FILE, figures)
        print_tables(context.console, figure_rows(figures))
        context.units.clear()

    def show(self, stage: Finished, given: Given) -> list[Showing]:
        """The tables."""
        figures = json.loads((stage.folder / _FILE).read_text(encoding="utf-8"))
        return [FigureTable(title, columns, rows) for title, columns, rows in figure_rows(figures)]


class _DanceEvaluation:
    """What one evaluation measures."""

    def __init__(self, context: StageContext) -> None:
        self.context, self.config = context, context.config
        found = bundle_driven_by("audio", context.every("generators"), context.shelf)
        if found is None:
            raise UserError(f"stage '{context.name}': no generator of this run is conditioned on music")
        self.bundle: Bundle = found
        data = context.given["data"]
        self.dataset, self.train = data.held_out(prefer="test"), data.split("train")
        require_dances(self.dataset)
        require_dances(self.train)
        self.fps = self.dataset.layout.fps
        self.clips = self._dances(self.dataset, self.config.clips, self.bundle.generator.unit_frames)

    def _dances(self, dataset: ClipDataset, count: int, unit: int = 1) -> list[DanceClip]:
        """Dances that are long enough to be measured, cut to what the generator can make."""
        longest = min(self.config.seconds or np.inf, self.bundle.max_seconds)
        cut = None if np.isinf(longest) else float(longest)
        found = dances_of(dataset, count, unit=unit, seconds=cut)
        found = [clip for clip in found if len(clip.joints) >= MIN_FRAMES]
        if not found:
            raise UserError(
                f"{self.dataset.where}: no clip with music of split '{dataset.split}' is long enough to be "
                f"measured"
            )
        return found

    def figures(self) -> dict[str, Any]:
        """All figures, each beside its trivial answers."""
        config, seed, clips = self.config, self.context.seed, self.clips
        pool = self._dances(self.train, config.pool)
        real = [clip.joints for clip in clips]
        self.true = features_of(real, self.fps, config.feature_fps)
        apart = others(clips, config.shuffles, seed)
        made = self.generated()
        rng = np.random.default_rng([seed, 17])
        still = [mean_pose(pool, len(clip.joints)) for clip in clips]
        answers: dict[str, list[list[Joints]]] = {
            "ground_truth": [real],
            "generated": made,
            "random_training_dance": [random_dances(pool, clips, rng) for _ in range(config.repeats)],
            "mean_pose": [still],
        }
        nearest = nearest_dances(self.train, pool, self.dataset, clips)
        if nearest is not None:
            answers["nearest_music"] = [nearest]
        rows: dict[str, Any] = {
            name: _intervals([self.measure(motions, clips) for motions in repeats])
            for name, repeats in answers.items()
        }
        variety = multimodality_of(self.true, [features_of(m, self.fps, config.feature_fps) for m in made])
        if variety:
            rows["generated"]["multimodality"] = {k: Interval.of(v) for k, v in variety.items()}
        rows["generated"]["way"] = {}
        if any(apart):
            crossed = [self.shuffled(motions, clips, apart) for motions in made]
            rows["shuffled_music"] = _intervals(crossed)
            true = alignment_of([Matched(clip.joints, clip) for clip in clips])
            ways = [
                way(alignment_of(_matched(motions, clips)), group["beat_align"], true)
                for motions, group in zip(made, crossed, strict=True)
            ]
            rows["generated"]["way"] = _intervals([{"way": w} for w in ways]).get("way", {})
        return {
            "split": self.dataset.split,
            "clips": len(clips),
            "songs": len({clip.song for clip in clips}),
            "repeats": config.repeats,
            "feature_fps": config.feature_fps,
            "chance": chances(clips),
            "rows": rows,
        }

    def share(self) -> None:
        """This process's share of the dances."""
        units, pieces = self.context.units, self.pieces
        sizes = [piece.stop - piece.start for _, piece in pieces]
        with bar(self.context.console) as progress:
            task = progress.add_task("generating", total=units.mine(sizes), note="")
            units.make(
                "generated",
                len(sizes),
                lambda k: self.dance(*pieces[k]),
                lambda k: progress.advance(task, sizes[k]),
            )

    @cached_property
    def pieces(self) -> list[tuple[int, slice]]:
        """Repeats and clips that are danced together."""
        found = even_slices(len(self.clips), _AT_ONCE)
        return [(repeat, piece) for repeat in range(self.config.repeats) for piece in found]

    def dance(self, repeat: int, piece: slice) -> Arrays:
        """Joints [T, N, 3] of dances to some clips' own music, by their numbers."""
        some = self.clips[piece]
        motions = self.bundle.generate(
            sounds=[clip.sound for clip in some],
            music=[clip.music for clip in some],
            seconds=[clip.seconds for clip in some],
            seed=self.context.seed + 7919 * (repeat + 1) + piece.start,
            sampling=self.config.sampling,
        )
        return {f"{number:06d}": motion.joints for number, motion in enumerate(motions)}

    def generated(self) -> list[list[Joints]]:
        """Dances to all clips' own music, once for each repeat."""
        out: list[list[Joints]] = [[] for _ in range(self.config.repeats)]
        found = self.context.units.read("generated", len(self.pieces))
        for (repeat, _), motions in zip(self.pieces, found, strict=True):
            out[repeat] += [motions[name] for name in sorted(motions)]
        return out

    def measure(self, motions: Sequence[Joints], clips: Sequence[DanceClip]) -> Group:
        """The figures of one motion for each clip, against the clip's own music."""
        matched = _matched(motions, clips)
        found = features_of(motions, self.fps, self.config.feature_fps)
        return {
            "beat_align": alignment_of(matched),
            "recognition": recognition_of(matched),
            "feet": feet_of(motions, self.fps),
            "distribution": distribution_of(self.true, found),
        }

    def shuffled(
        self, motions: Sequence[Joints], clips: Sequence[DanceClip], apart: Sequence[Sequence[int]]
    ) -> Group:
        """The same motions against the music of other songs, over the seconds that both last."""
        matched = [Matched(m, clips[k]) for m, row in zip(motions, apart, strict=True) for k in row]
        return {"beat_align": alignment_of(matched), "recognition": recognition_of(matched)}


def _matched(motions: Sequence[Joints], clips: Sequence[DanceClip]) -> list[Matched]:
    return [Matched(joints, clip) for joints, clip in zip(motions, clips, strict=True)]


def _intervals(repeats: Sequence[Group]) -> dict[str, dict[str, Interval]]:
    """Mean and interval of each figure over the repeats that have it."""
    values: dict[str, dict[str, list[float]]] = {}
    for groups in repeats:
        for group, figures in groups.items():
            for name, value in figures.items():
                values.setdefault(group, {}).setdefault(name, []).append(value)
    return {g: {name: Interval.of(v) for name, v in figures.items()} for g, figures in values.items()}


_ROWS = (
    ("ground_truth", "ground truth"),
    ("generated", "generated from its music"),
    ("shuffled_music", "the same under other music"),
    ("nearest_music", "training dance to the nearest music"),
    ("random_training_dance", "random training dance"),
    ("mean_pose", "mean pose, still"),
)


def _definitions() -> dict[str, str]:
    """A definition's name -> the title of its column; equal definitions share one."""
    shared: dict[Any, list[str]] = {}
    for name, definition in DEFINITIONS.items():
        shared.setdefault(definition, []).append(name)
    return {names[0]: " = ".join(names) for names in shared.values()}


def figure_rows(figures: dict[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    """(title, columns, rows) of each table; the report draws the same ones."""
    where = f"{figures['clips']} {figures['split']} clips of {figures['songs']} songs"
    beats = {("beat_align", name): title for name, title in _definitions().items()}
    way_of = {("way", name): f"way to the truth, {title}" for name, title in _definitions().items()}
    guess = {("recognition", name): value for name, value in figures["chance"].items()}
    seen = {
        ("recognition", "genre"): "genre",
        ("recognition", "style"): "style",
        ("recognition", "tempo"): "tempo within 5 %",
        ("recognition", "tempo_error"): "tempo error",
    }
    spread = {
        ("distribution", "fid_k"): "FID_k",
        ("distribution", "fid_m"): "FID_m",
        ("distribution", "div_k"): "Div_k",
        ("distribution", "div_m"): "Div_m",
        ("multimodality", "mm_k"): "MM_k",
        ("multimodality", "mm_m"): "MM_m",
    }
    feet = {
        ("feet", "foot_skating"): "foot skating",
        ("feet", "foot_contact"): "foot contact score",
    }
    out = [_rows(f"Beat Align of dances on {where} (higher is better)", beats | way_of, figures)]
    title, columns, rows = _rows(f"What is danced, measured on the joints of {where}", seen, figures)
    if rows:
        rows.append(["always the commonest", *(f"{guess[key]:.3f}" if key in guess else "" for key in seen)])
        out.append((title, columns, rows))
    title = f"Distance to real dances and variety, at {figures['feature_fps']:g} frames a second"
    if figures["clips"] < KINETIC:
        # Covariances of fewer rows than columns are not of full rank.
        title += f"; {figures['clips']} clips are few for FID, whose features are up to {KINETIC}"
    out.append(_rows(title, spread, figures))
    out.append(_rows("Feet (lower is better)", feet, figures))
    return out


def _rows(
    title: str, columns: dict[tuple[str, str], str], figures: dict[str, Any]
) -> tuple[str, list[str], list[list[str]]]:
    rows, all_rows = [], figures["rows"].values()
    columns = {(g, f): name for (g, f), name in columns.items() if any(f in r.get(g, {}) for r in all_rows)}
    for key, name in _ROWS:
        found = figures["rows"].get(key, {})
        cells = [found.get(group, {}).get(figure) for group, figure in columns]
        if any(cells):
            rows.append([name, *("" if cell is None else interval(cell) for cell in cells)])
    return title, ["", *columns.values()], rows
