"""Generation stage: motions for held-out captions, written for tools and as a page to watch."""

from __future__ import annotations

from pydantic import Field

from motionloom.pipeline.evaluation.truth import spread, truth_of
from motionloom.pipeline.inference.bundle import Bundle, text_encoder_of
from motionloom.pipeline.inference.outputs import FORMATS, Format, write_motions
from motionloom.pipeline.inference.sampling import SamplingConfig
from motionloom.pipeline.stages.stage import StageConfig, StageContext
from motionloom.pipeline.store.data import held_out, open_split


class GenerateConfig(StageConfig):
    """Which captions, how drawn, written as what."""

    captions: list[str] = Field(default_factory=list)
    """Captions to perform; empty takes `count` from the test split."""
    count: int = Field(8, ge=1)
    sampling: SamplingConfig = SamplingConfig()
    formats: list[Format] = Field(default_factory=lambda: list(FORMATS))


def run_generate(context: StageContext) -> None:
    """Generate, decode and write."""
    config: GenerateConfig = context.config
    bundle = Bundle.from_parts(dict(context.inputs), text_encoder_of(context.input("text")), context.device)
    captions, faces = list(config.captions), list(config.captions)
    if not captions:
        data = context.input("data")
        dataset = open_split(data, held_out(data, prefer="test"))
        truths = [truth_of(dataset, i) for i in spread(dataset, config.count)]
        captions, faces = [t.caption for t in truths], [t.face_caption for t in truths]
    motions = bundle.generate(captions, face_captions=faces, seed=context.seed, sampling=config.sampling)
    write_motions(
        context.folder / "motions", motions, config.formats, title="Generated motions", seed=context.seed
    )
    for motion in motions:
        context.console.print(f"    {len(motion.joints) / motion.layout.fps:4.1f} s  {motion.caption}")
