"""Generation stage: motions for held-out captions and music, written for tools and as a page to watch."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import Field

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.printable import printable
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import (
    GENERATOR,
    Every,
    StageConfig,
    StageContext,
    StageKind,
    register,
)
from motionloom.pipeline.evaluation.dances import DanceClip, dance_to, dances_for, with_music
from motionloom.pipeline.evaluation.truth import perform, spread_truths
from motionloom.pipeline.inference.files.display_figure import FigureOptions
from motionloom.pipeline.inference.files.writers import WRITERS, Format, default_formats
from motionloom.pipeline.inference.generation import generate
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.render.sound import Score
from motionloom.pipeline.stages.results.evaluation import bundle_driven_by
from motionloom.pipeline.store.artifact import Terms


class GenerateConfig(StageConfig):
    """Captions, sampling settings and output formats."""

    captions: list[str] = Field(default_factory=list)
    """Captions to perform; empty takes `count` from the test split."""
    seconds: float | None = Field(None, gt=0)
    """Length of each; None lets the model decide, or else takes the recorded clip's."""
    count: int = Field(8, ge=0)
    dances: int = Field(4, ge=0)
    """Songs of the test split to dance to, where a generator is conditioned on music; different songs first.
    """
    dance_seconds: float = Field(20.0, ge=1)
    """Longer songs are cut to this."""
    sampling: SamplingConfig = SamplingConfig()
    formats: list[Format] = Field(default_factory=default_formats)
    figure: FigureOptions = FigureOptions()
    """Way in which the shown figure follows the generated joints."""


class GenerateStage(StageKind):
    """Motions for captions and music, written for tools and as a page to watch."""

    name = "generate"
    summary = "motions from captions and music"
    config = GenerateConfig
    offers = frozenset({"motions"})
    takes = ("data", Every("generators", GENERATOR, needed=True))
    version = 8  # notes where the clips state their truth

    def modules(self, config: GenerateConfig) -> Iterable[str]:
        return [*super().modules(config), *(WRITERS[name].write.__module__ for name in config.formats)]

    def run(self, context: StageContext) -> None:
        from motionloom.pipeline.inference.files.outputs import page_note, write_motions

        config: GenerateConfig = context.config
        (said, notes) = _performed(context)
        danced = _danced(context)
        if not said and not danced:
            raise UserError(
                f"stage '{context.name}': nothing to generate from: no held-out clip has a caption or music "
                f"that a generator of this run is conditioned on; give captions"
            )
        terms = Terms.of(stage.folder for stage in context.inputs.values())
        motions = [*said, *(motion for motion, _ in danced)]
        write_motions(
            context.folder / "motions",
            motions,
            config.formats,
            title=f"Generated motions of {context.recipe}",
            note=page_note(len(motions), context.recipe, context.seed, terms=terms),
            scores=[Score()] * len(said) + [clip.score() for _, clip in danced],
            notes=[*notes, *([] for _ in danced)],
            figure=config.figure,
        )
        titles = [motion.caption for motion in said] + [f"dance to {clip.title}" for _, clip in danced]
        for motion, title in zip(motions, titles, strict=True):
            line = f"    {len(motion.joints) / motion.layout.fps:4.1f} s  {printable(title)}"
            context.console.print(line, markup=False)
        for note in dict.fromkeys(note for own in notes for note in own):
            context.console.print(f"    {printable(note)}", markup=False)


def _performed(context: StageContext) -> tuple[list[GeneratedMotion], list[list[str]]]:
    """Motions for the captions of the config, or of held-out clips, and what each does not show."""
    config: GenerateConfig = context.config
    bundle = bundle_driven_by("text", context.every("generators"), context.stage_cache)
    seconds = config.seconds
    seed = context.seed
    sampling = config.sampling
    if bundle is None:
        if config.captions:
            raise UserError(
                f"stage '{context.name}': captions are given and no generator is conditioned on text"
            )
        return [], []
    if config.captions:
        said = config.captions
        asked = Request.of(said, face=said, seconds=seconds, seed=seed, sampling=sampling)
        made = generate(bundle, asked)
    else:
        truths = spread_truths(context.given["data"].held_out(prefer="test"), config.count)
        made = perform(bundle, truths, seconds=seconds, seed=seed, sampling=sampling) if truths else []
    return made, [bundle.find_mismatches([motion]) for motion in made]


def _danced(context: StageContext) -> list[tuple[GeneratedMotion, DanceClip]]:
    """Dances to the music of held-out clips."""
    config: GenerateConfig = context.config
    dataset = context.given["data"].held_out(prefer="test")
    if not config.dances or not with_music(dataset).any():
        return []
    bundle = bundle_driven_by("audio", context.every("generators"), context.stage_cache)
    if bundle is None:
        return []
    clips = dances_for(bundle, dataset, config.dances, seconds=config.dance_seconds)
    if not clips:
        return []
    made = dance_to(bundle, clips, seed=context.seed, sampling=config.sampling)
    return list(zip(made, clips, strict=True))


register(GenerateStage())
