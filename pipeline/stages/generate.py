"""Generation stage: motions for held-out captions or music, written for tools and as a page to watch."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import GENERATOR, Every, StageConfig, StageContext, StageKind
from motionloom.pipeline.evaluation.example_clips import example_clips, perform
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.outputs import FORMATS, Format, write_motions


class GenerateConfig(StageConfig):
    """Which captions, how drawn, written as what."""

    captions: list[str] = Field(default_factory=list)
    """Captions to perform; empty takes the captions, or the music, of `count` clips of the test split."""
    count: int = Field(8, ge=1)
    sampling: SamplingConfig = SamplingConfig()
    formats: list[Format] = Field(default_factory=lambda: list(FORMATS))


class GenerateStage(StageKind):
    """Motions for captions, written for tools and as a page to watch."""

    name = "generate"
    summary = "motions from captions or music"
    config = GenerateConfig
    takes = ("data", Every("generators", GENERATOR))
    version = 3  # generators as the recipe has them

    def gives(self, config: Any) -> frozenset[str]:
        """Files to watch."""
        return frozenset({"motions"})

    def run(self, context: StageContext) -> None:
        """Generate, decode and write."""
        config: GenerateConfig = context.config
        bundle = Bundle(context.every("generators"), context.shelf)
        if config.captions:
            motions = bundle.generate(
                config.captions, face_captions=config.captions, seed=context.seed, sampling=config.sampling
            )
        else:
            dataset = context.given["data"].held_out(prefer="test")
            chosen = example_clips(dataset, config.count, bundle.generator.modalities)
            motions = perform(bundle, chosen, seed=context.seed, sampling=config.sampling)
        write_motions(
            context.folder / "motions", motions, config.formats, title="Generated motions", seed=context.seed
        )
        for motion in motions:
            title = motion.caption or "to music"
            context.console.print(f"    {len(motion.joints) / motion.layout.fps:4.1f} s  {title}")
