"""DMD stage: the diffusion decoder of motion tokens (UDE section 3.4)."""

from __future__ import annotations

from pydantic import Field

from motionloom.datasets.base.errors import UserError
from motionloom.models.diffusion.dmd import Dmd, DmdConfig
from motionloom.models.tokenizer.base import GROUP_FRAMES
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import register
from motionloom.pipeline.stages.networks.clips import motion_example
from motionloom.pipeline.stages.networks.tokenizer import WindowInputs, WindowStageConfig, window_batches
from motionloom.pipeline.store.networks import LoadedWindowed, TrainedTokenizer, require_streams, stream_facts
from motionloom.pipeline.store.weights import ModelFacts
from motionloom.pipeline.training.config import TrainConfig
from motionloom.pipeline.training.trained_stage import Batches, Example, Log, TrainedStage


class DmdStageConfig(WindowStageConfig):
    """A diffusion decoder of the tokens of one tokenizer."""

    net: DmdConfig = DmdConfig()
    optim: OptimConfig = OptimConfig(optimizer="adam")
    train: TrainConfig = TrainConfig(steps=200_000, batch_size=64)
    window: int = Field(160, ge=8, multiple_of=4)
    """Frames of a training window; longer motions are decoded in overlapping windows of this size."""


class DmdInputs(WindowInputs):
    """Windows and the tokenizer of their tokens."""

    tokenizer: TrainedTokenizer


class DmdStage(TrainedStage[DmdStageConfig, DmdInputs, Dmd]):
    """Tokens to varied motion."""

    name = "dmd"
    summary = "diffusion decoder of motion tokens"
    trainer = "motionloom.models.diffusion.module:DmdModule"
    config = DmdStageConfig
    offers = frozenset({"decoder"})
    inputs = DmdInputs
    curves = (Curve("loss"),)
    exports = ("tokenizer",)

    def facts(self, config: DmdStageConfig, inputs: DmdInputs) -> ModelFacts:
        tokenizer = inputs.tokenizer.net
        if config.net.schedule.predicts == "epsilon" and config.net.dim < tokenizer.dim:
            raise UserError(
                f"net.dim {config.net.dim} cannot carry the noise of {tokenizer.dim} columns, and a network "
                f"that predicts the noise has to give back: raise net.dim to {tokenizer.dim} or more, or set "
                f"net.schedule.predicts: sample"
            )
        extra = {**stream_facts(tokenizer), "window": config.window}
        return ModelFacts.of(self.name, config.net, inputs.data.layout, extra)

    def network(self, facts: ModelFacts, inputs: DmdInputs) -> Dmd:
        tokenizer = inputs.tokenizer.net
        require_streams(facts, tokenizer, "decoder")
        config = DmdConfig.parse(facts.config, facts.where)
        return Dmd(config, tokenizer.streams, tokenizer.pattern, tokenizer.dim)

    def module_settings(self, config: DmdStageConfig, net: Dmd, inputs: DmdInputs) -> dict[str, object]:
        return {"tokenizer": inputs.tokenizer.net}

    def batches(self, config: DmdStageConfig, net: Dmd, inputs: DmdInputs, seed: int, log: Log) -> Batches:
        columns = inputs.tokenizer.columns
        window = config.window
        return window_batches(
            config, inputs, columns, seed, batch_size=32, max_frames=window, min_frames=GROUP_FRAMES
        )

    def example(self, config: DmdStageConfig, net: Dmd, inputs: DmdInputs, batch: int) -> Example:
        return Example(motion_example(batch, config.window, net.motion_dim))

    def loaded(self, net: Dmd, facts: ModelFacts, inputs: DmdInputs) -> LoadedWindowed[Dmd]:
        return LoadedWindowed(net, facts.fact("window", int), inputs)


register(DmdStage())
