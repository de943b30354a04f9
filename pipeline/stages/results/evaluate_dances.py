"""Evaluation of dances: motion generated from held-out music, beside recorded dances and baselines."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from pydantic import Field

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import GENERATOR, Every, StageConfig, StageContext, register
from motionloom.pipeline.contract.units import Arrays, Row, even_slices
from motionloom.pipeline.evaluation.clip_metrics import (
    BEAT_ALIGN,
    MIN_FRAMES,
    RECOGNITION,
    Joints,
    Performance,
    clip_figures,
    measure_clip,
    metrics_of,
)
from motionloom.pipeline.evaluation.dances import (
    SOUND,
    DanceClip,
    commonest,
    dance_to,
    dances_for,
    digest_of_dances,
    other_songs,
    require_dances,
    seed_frames,
)
from motionloom.pipeline.evaluation.estimate import plain
from motionloom.pipeline.evaluation.figures import (
    CHANCE,
    MODEL,
    NEAREST_MUSIC,
    OTHER_MUSIC,
    RANDOM_DANCE,
    RECORDED,
    STILL,
    Fact,
    FigureFile,
    group_figures,
)
from motionloom.pipeline.evaluation.movement import FEATURE_FPS, all_features, movement_figures
from motionloom.pipeline.evaluation.reference_baselines import mean_poses, nearest_dances, random_dances
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.stages.results.evaluation import Evaluation, EvaluationStage, bundle_driven_by

_AT_ONCE = 16
"""Dances generated together, at most."""


class EvaluateDancesConfig(StageConfig):
    """Extent of the measurement."""

    clips: int | None = Field(100, ge=2)
    """At most this many clips with music of the test split, different songs first; null takes all."""
    repeats: int = Field(5, ge=1)
    """Dances generated to each clip's music; MultiModality needs 2."""
    decodings: int = Field(1, ge=1)
    """Dances that a diffusion decoder makes of each repetition's tokens (UDE Tables 1 and 2: 30)."""
    seconds: float | None = Field(None, ge=1)
    """Longer clips are cut to this."""
    shuffles: int = Field(5, ge=1)
    """Other songs that each dance is compared with, for the beats of shuffled music."""
    pool: int = Field(400, ge=2)
    """Training dances that the reference baselines choose from, at most."""
    sampling: SamplingConfig = SamplingConfig()


class EvaluateDancesStage(EvaluationStage):
    """Dances to held-out music."""

    name = "evaluate_dances"
    summary = "figures of dances to held-out music"
    config = EvaluateDancesConfig
    takes = ("data", Every("generators", GENERATOR, needed=True))

    def evaluation(self, context: StageContext) -> _DanceEvaluation:
        return _DanceEvaluation(context)


class _DanceEvaluation(Evaluation):
    """The motions and references of one evaluation."""

    def __init__(self, context: StageContext) -> None:
        super().__init__(context)
        found = bundle_driven_by("audio", context.every("generators"), context.stage_cache)
        if found is None:
            raise UserError(f"stage '{context.name}': no generator of this run is conditioned on music")
        self.bundle: Bundle = found
        require_dances(self.dataset)
        require_dances(self.train)
        self.fps = self.dataset.layout.fps
        self.begun = seed_frames(self.bundle)
        """Frames that the model is given of each recording: they are not measured."""
        self.whole = self._dances(self.dataset, self.config.clips)
        self.clips = [clip.after(self.begun) for clip in self.whole]

    def _dances(self, dataset: ClipDataset, count: int | None, unit: int | None = None) -> list[DanceClip]:
        """Dances that are long enough to be measured, cut to what the generator can make."""
        seconds = self.config.seconds
        found = dances_for(self.bundle, dataset, count, seconds=seconds, least=MIN_FRAMES, unit=unit)
        if not found:
            raise UserError(
                f"{self.dataset.where}: no clip with music of split '{dataset.split}' is long enough to be "
                f"measured"
            )
        return found

    def share(self) -> None:
        """This process's share of the dances."""
        self.drawn_as(self.bundle)
        pieces = self.pieces
        sizes = [piece.stop - piece.start for _, piece in pieces]
        self.make("generated", "generating", sizes, lambda k: self.dance(*pieces[k]))
        self.make_reference(SOUND)

    @cached_property
    def pieces(self) -> list[tuple[int, slice]]:
        """Draws and clips that are danced together."""
        return self.in_turn(even_slices(len(self.clips), _AT_ONCE))

    def dance(self, draw: int, piece: slice) -> Arrays:
        """Joints [T, N, 3] of dances to some clips' own music, by their numbers."""
        some = self.whole[piece]
        seed, noise_seed = self.seeds(draw, piece.start)
        drawn = {"seed": seed, "noise_seed": noise_seed, "sampling": self.config.sampling}
        motions = dance_to(self.bundle, some, **drawn)
        return {f"{number:06d}": motion.joints[self.begun :] for number, motion in enumerate(motions)}

    @cached_property
    def protocol(self) -> dict[str, Fact]:
        """Return the settings behind the figures, but for the seed."""
        config = self.config
        clips = self.clips
        maker = self.bundle.generator
        return {
            "split": self.dataset.split,
            "clips": len(clips),
            "songs": len({clip.song for clip in clips}),
            "clips_sha256": digest_of_dances(clips),
            "shuffles": config.shuffles,
            "feature_fps": FEATURE_FPS,
            **({"seed_motion": f"the first {self.begun} frames of each recording"} if self.begun else {}),
            **({"note": maker.capabilities.note} if maker.capabilities.note else {}),
            **self.drawn_as(self.bundle),
        }

    def measured(self) -> FigureFile:
        """All figures, each beside its reference baselines."""
        clips = self.clips
        motions = {MODEL: self.generated()} | self.baselines()
        rows = {row: [self.each(one) for one in repeats] for row, repeats in motions.items()}
        apart = other_songs(clips, self.config.shuffles, self.context.seed)
        if any(apart):
            rows[OTHER_MUSIC] = self.under_other_music(motions[MODEL], apart)
        figures = clip_figures(metrics_of("dances"), rows, self.protocol)
        chance = plain({f"recognition.{name}": share for name, share in commonest(clips).items()})
        figures += group_figures(RECOGNITION.name, RECOGNITION.columns, {CHANCE: chance}, self.protocol)
        features = {row: [all_features(one, self.fps) for one in repeats] for row, repeats in motions.items()}
        real = features[RECORDED][0]
        figures += movement_figures(self.reference(SOUND), real, features, self.protocol)
        return FigureFile("evaluate_dances", tuple(figures), self.about(self.bundle))

    def baselines(self) -> dict[str, list[list[Joints]]]:
        """Dances that need no model, once or several times."""
        clips = self.clips
        pool = self._dances(self.train, self.config.pool, unit=1)
        real = [clip.joints for clip in clips]
        rng = np.random.default_rng([self.context.seed, 17])
        out = {
            RECORDED: [real],
            RANDOM_DANCE: [random_dances(pool, clips, rng) for _ in range(self.config.repeats)],
            STILL: [mean_poses([clip.joints for clip in pool], self.fps, [len(joints) for joints in real])],
        }
        nearest = nearest_dances(self.train, pool, self.dataset, clips)
        return out if nearest is None else out | {NEAREST_MUSIC: [nearest]}

    def generated(self) -> list[list[Joints]]:
        """Dances to all clips' own music, once for each draw."""
        out: list[list[Joints]] = [[] for _ in range(self.draws)]
        found = self.context.units.read("generated", len(self.pieces))
        for (draw, _), motions in zip(self.pieces, found, strict=True):
            out[draw] += [motions[name] for name in sorted(motions)]
        return out

    def each(self, motions: Sequence[Joints]) -> list[Row]:
        """The values of one motion for each clip, against the clip's own music."""
        pairs = zip(motions, self.clips, strict=True)
        return [measure_clip(metrics_of("dances"), _performance(joints, clip)) for joints, clip in pairs]

    def under_other_music(
        self, repeats: Sequence[Sequence[Joints]], apart: Sequence[Sequence[int]]
    ) -> list[list[Row]]:
        """The same dances against the music of other songs, over the seconds that both last.

        Every other song counts as one more repeat; a clip that has fewer of them has empty rows.
        """
        most = max(map(len, apart))
        metrics = (BEAT_ALIGN, RECOGNITION)
        return [
            [
                measure_clip(metrics, _performance(joints, self.clips[row[turn]])) if turn < len(row) else {}
                for joints, row in zip(motions, apart, strict=True)
            ]
            for motions in repeats
            for turn in range(most)
        ]


def _performance(joints: Joints, clip: DanceClip) -> Performance:
    return Performance(joints, clip.joints, clip.fps, truth=clip.truth, beats=clip.beats)


register(EvaluateDancesStage())
