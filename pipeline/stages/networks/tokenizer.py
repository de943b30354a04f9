"""Tokenizer stages: H2VQ, VQ, RVQ, FSQ, UDE's; body-hand, body or face (HumanTOMATO section 3.2, B.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, create_model
from torch.utils.data import Dataset

from motionloom.datasets.base.errors import UserError
from motionloom.models.tokenizer.base import GROUP_FRAMES, Tokenizer, TokenizerConfig
from motionloom.models.tokenizer.body_hand import H2VQConfig, SeparateConfig
from motionloom.models.tokenizer.single import FsqConfig, MqConfig, RvqConfig, VqConfig
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import Inputs, Stage, filled_by, register
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.stages.networks.clips import motion_example
from motionloom.pipeline.store.networks import TrainedTokenizer
from motionloom.pipeline.store.weights import ModelFacts
from motionloom.pipeline.training.config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.training.trained_stage import Batches, Example, Log, TrainedStage
from motionloom.pipeline.training.warm_start import require_same_start, require_start_layout

if TYPE_CHECKING:
    from motionloom.datasets.loading.plan import Share
    from motionloom.datasets.loading.statistics import FeatureStats
    from motionloom.pipeline.store.data import Data

_FREE = frozenset(
    {
        "recon", "velocity_weight", "alpha", "decay", "reset_below",
        "codebook_weight", "commitment_weight", "start",
    }
)  # fmt: skip
"""Settings that are of the training and not of the network: another one may go on with others."""


class WindowStageConfig(TrainedStageConfig):
    """Settings of stages that train on windows of clips."""

    window: int = Field(64, ge=4, multiple_of=4)
    """Frames of a training window."""


class TokenizerStageConfig(WindowStageConfig):
    """Settings of every tokenizer stage; subclasses set the default of `net`."""

    train: TrainConfig = TrainConfig(steps=100_000, batch_size=256)
    net: TokenizerConfig

    def require_fit(self, hardware: Hardware) -> None:
        """A codebook must get several times the vectors that it resets codes below."""
        super().require_fit(hardware)
        resets = self.net.codes_and_reset()
        if resets is not None:
            vectors = self.train.batch_size // self.train.accumulate * self.window // GROUP_FRAMES
            require_uses(vectors, *resets)


def require_uses(vectors: int, codes: int, reset_below: float, *, times: float = 2.0) -> None:
    """A codebook must get `times` the vectors of an update that it resets codes below."""
    if vectors < times * codes * reset_below:
        raise UserError(
            f"a codebook of {codes} codes gets {vectors} vectors an update and resets codes used less than "
            f"{reset_below:g} times: it would replace codes for ever. Set net.reset_below to "
            f"{vectors / codes / 4:.2g} or less, or raise train.batch_size"
        )


def stage_config(net: TokenizerConfig) -> type[TokenizerStageConfig]:
    """Return the settings of a stage of one kind of tokenizer, by the defaults of its network."""
    return create_model(f"{net.kind}_stage", __base__=TokenizerStageConfig, net=(type(net), net))


class WindowInputs(Inputs):
    """Inputs of stages that train on windows."""

    data: Data
    stats: FeatureStats


class TokenizerInputs(WindowInputs):
    """Windows, and a tokenizer to go on from."""

    start: TrainedTokenizer | None = filled_by("tokenizer")


class TokenizerStage(TrainedStage[TokenizerStageConfig, TokenizerInputs, Tokenizer]):
    """A tokenizer, trained on windows of the training split."""

    inputs = TokenizerInputs
    curves = tuple(Curve(name) for name in ("recon", "perplexity", "usage", "dead", "resets"))
    offers = frozenset({"tokenizer"})
    trainer = "motionloom.models.tokenizer.module:TokenizerModule"
    exports = ("stats",)

    def __init__(self, name: str, summary: str, config: type[TokenizerStageConfig]) -> None:
        self.name = name
        self.summary = summary
        self.config = config

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:
        """A tokenizer that it starts from must be the same network over equally normalised motion."""
        require_same_start(stage, others, _FREE, ("stats",))

    def facts(self, config: TokenizerStageConfig, inputs: TokenizerInputs) -> ModelFacts:
        if inputs.start is not None:
            require_start_layout(inputs.data.layout, inputs.start.layout)
        return ModelFacts.of(config.net.kind, config.net, inputs.data.layout)

    def network(self, facts: ModelFacts, inputs: TokenizerInputs) -> Tokenizer:
        kind = type(self.config.model_fields["net"].default)
        config: TokenizerConfig = kind.parse(facts.config, f"{facts.where}: config")
        return config.build(facts.layout.layout())

    def prepare(self, config: TokenizerStageConfig, net: Tokenizer, inputs: TokenizerInputs) -> None:
        """The coordinates it learns in depend on how features are normalised; or all comes from a start."""
        if inputs.start is not None:
            net.load_state_dict(inputs.start.net.state_dict())
            return
        columns = net.columns.numpy()
        stats = inputs.stats
        net.basis.learn(stats.mean[columns], stats.std[columns])

    def batches(
        self, config: TokenizerStageConfig, net: Tokenizer, inputs: TokenizerInputs, seed: int, log: Log
    ) -> Batches:
        # Validation has enough tokens in a batch that its perplexity compares with training's.
        columns = net.columns.numpy()
        return window_batches(config, inputs, columns, seed, batch_size=64, max_frames=4 * config.window)

    def example(
        self, config: TokenizerStageConfig, net: Tokenizer, inputs: TokenizerInputs, batch: int
    ) -> Example:
        per_group = " + ".join(f"{s.per_group} {s.name}" for s in net.streams)
        note = f"{per_group} per {GROUP_FRAMES} frames, {net.bits_per_second:.0f} bit/s"
        return Example(motion_example(batch, config.window, net.dim), note)

    def loaded(self, net: Tokenizer, facts: ModelFacts, inputs: TokenizerInputs) -> TrainedTokenizer:
        return TrainedTokenizer(net.freeze(), inputs)


def window_batches(
    config: WindowStageConfig, inputs: WindowInputs, columns: NDArray[np.int64], seed: int, **validation: Any
) -> Batches:
    """Windows of the training split; validation on held-out clips, as `EvalBatches` takes it."""
    from motionloom.datasets.loading.batches import WindowBatches
    from motionloom.datasets.loading.condition_batches import EvalBatches

    data = inputs.data
    stats = inputs.stats
    dataset = data.split("train")
    window = config.window

    def train(batch: int, share: Share) -> Dataset[object]:
        return WindowBatches(
            dataset, stats, window=window, seed=seed, columns=columns, batch_size=batch, share=share
        )

    return Batches(train, lambda: EvalBatches(data.held_out(), stats, columns=columns, **validation))


for _net, _summary in (
    (H2VQConfig(), "H2VQ tokenizer"),
    (VqConfig(), "VQ tokenizer"),
    (RvqConfig(), "RVQ tokenizer"),
    (SeparateConfig(), "body and hands apart"),
    (FsqConfig(), "FSQ tokenizer"),
    (MqConfig(), "UDE's motion quantization"),
):
    register(TokenizerStage(_net.kind, _summary, stage_config(_net)))
