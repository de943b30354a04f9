"""Tokenizer stages: H2VQ, VQ, RVQ, FSQ; body-hand, body only or face (HumanTOMATO section 3.2, B.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from pydantic import Field
from torch import nn

from motionloom.datasets.schema import UserError
from motionloom.models.tokenizer.base import GROUP_FRAMES, Tokenizer
from motionloom.models.tokenizer.build import build_tokenizer
from motionloom.models.tokenizer.config import (
    AnyTokenizerConfig,
    EmaTokenizerConfig,
    FsqConfig,
    H2VQConfig,
    MqConfig,
    RvqConfig,
    SeparateConfig,
    VqConfig,
    parse_tokenizer,
)
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import Given, Stage
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.stages.starting import START, require_same_start, require_start_layout
from motionloom.pipeline.stages.train_config import TrainConfig, TrainedStageConfig
from motionloom.pipeline.stages.trained import Batches, Example, Say, TrainedStage
from motionloom.pipeline.stages.windows import window_batches
from motionloom.pipeline.store.networks import TrainedTokenizer
from motionloom.pipeline.store.weights import LayoutFacts, ModelFacts

if TYPE_CHECKING:
    from motionloom.models.tokenizer.module import TokenizerModule

_FREE = frozenset(
    {
        "recon", "velocity_weight", "alpha", "decay", "reset_below",
        "codebook_weight", "commitment_weight", "start",
    }
)  # fmt: skip
"""Settings that are of the training and not of the network: another one may go on with others."""


class TokenizerStageConfig(TrainedStageConfig):
    """What every tokenizer stage has."""

    train: TrainConfig = TrainConfig(steps=100_000, batch_size=256)
    window: int = Field(64, ge=4, multiple_of=4)
    """Frames of a training window."""
    windows_per_clip: int = Field(1, ge=1)
    """Windows cut from one read of a clip."""
    net: AnyTokenizerConfig

    def require_fit(self, hardware: Hardware) -> None:
        """A codebook must get several times the vectors that it resets codes below."""
        super().require_fit(hardware)
        net = self.net
        if not isinstance(net, EmaTokenizerConfig | MqConfig):
            return
        if isinstance(net, MqConfig) and net.quantizer != "ema":
            return  # codes learnt by gradient are never reset
        vectors = self.train.batch_size // self.train.accumulate * self.window // GROUP_FRAMES
        needed = 2 * net.num_codes * net.reset_below
        if vectors < needed:
            raise UserError(
                f"a codebook of {net.num_codes} codes gets {vectors} vectors an update and resets codes "
                f"used less than {net.reset_below:g} times: it would replace codes for ever. Set "
                f"net.reset_below to {vectors / net.num_codes / 4:.2g} or less, or raise "
                "train.batch_size"
            )


class H2VQStageConfig(TokenizerStageConfig):
    """Body and hand codebooks with their hierarchy."""

    net: H2VQConfig = H2VQConfig()


class VqStageConfig(TokenizerStageConfig):
    """One codebook."""

    net: VqConfig = VqConfig()


class RvqStageConfig(TokenizerStageConfig):
    """Residual codebooks (body-only data, face)."""

    net: RvqConfig = RvqConfig()


class SeparateStageConfig(TokenizerStageConfig):
    """Body and hands apart, the ablation of H2VQ."""

    net: SeparateConfig = SeparateConfig()


class FsqStageConfig(TokenizerStageConfig):
    """Finite scalar quantization."""

    net: FsqConfig = FsqConfig()


class MqStageConfig(TokenizerStageConfig):
    """UDE's motion quantization."""

    net: MqConfig = MqConfig()


class TokenizerStage(TrainedStage):
    """A tokenizer, trained on windows of the training split."""

    takes = ("data", "stats", "start?: tokenizer")
    version = 2  # fingers in the palm's frame (`finger_gain`)

    def __init__(self, name: str, summary: str, config: type[TokenizerStageConfig]) -> None:
        self.name, self.summary, self.config = name, summary, config

    def gives(self, config: Any) -> frozenset[str]:
        """Tokens of motion, and motion of tokens."""
        return super().gives(config) | {"tokenizer"}

    def check(self, stage: Stage, others: Mapping[str, Stage]) -> None:
        """A tokenizer that it starts from must be the same network over equally normalised motion."""
        require_same_start(stage, others, _FREE)

    def facts(self, config: TokenizerStageConfig, given: Given) -> ModelFacts:
        """Config and layout."""
        if START in given:
            require_start_layout(given["data"].layout, given[START].layout)
        layout = LayoutFacts.of(given["data"].layout)
        return ModelFacts(kind=config.net.kind, config=config.net.dump(), layout=layout)

    def network(self, facts: ModelFacts, given: Given) -> Tokenizer:
        """The tokenizer of the layout's columns."""
        config = parse_tokenizer(facts.config, f"{facts.where}: config")
        return build_tokenizer(config, facts.layout.layout())

    def prepare(self, config: TokenizerStageConfig, net: Tokenizer, given: Given) -> None:
        """The coordinates it learns in depend on how features are normalised; or all comes from a start."""
        if START in given:
            net.load_state_dict(given[START].net.state_dict())
            return
        columns, stats = net.columns.numpy(), given["stats"]
        net.basis.learn(stats.mean[columns], stats.std[columns])

    def module(self, config: TokenizerStageConfig, net: Any, given: Given, seed: int) -> TokenizerModule:
        """Reconstruction and commitment."""
        from motionloom.models.tokenizer.module import TokenizerModule

        steps = config.train.steps
        return TokenizerModule(net, config.optim, seed=seed, max_steps=steps, **config.net.loss_terms())

    def batches(
        self, config: TokenizerStageConfig, net: nn.Module, given: Given, seed: int, say: Say
    ) -> Batches:
        """Windows; validation on longer stretches."""
        assert isinstance(net, Tokenizer)
        # Validation has enough tokens in a batch that its perplexity compares with training's.
        columns = net.columns.numpy()
        return window_batches(config, given, columns, seed, batch_size=64, max_frames=4 * config.window)

    def example(self, config: TokenizerStageConfig, net: Any, given: Given, batch: int) -> Example:
        """A batch of windows."""
        per_group = " + ".join(f"{s.per_group} {s.name}" for s in net.streams)
        return Example(
            {
                "motion": torch.empty(batch, config.window, net.dim),
                "length": torch.full((batch,), config.window),
            },
            f"{per_group} per {GROUP_FRAMES} frames, {net.bits_per_second:.0f} bit/s",
        )

    def loaded(self, net: Tokenizer, facts: ModelFacts, given: Given) -> TrainedTokenizer:
        """The tokenizer, frozen, with the statistics of its input."""
        return TrainedTokenizer(net.freeze(), given)

    def exported(self, config: Any) -> tuple[str, ...]:
        """Statistics turn what it decodes into metres."""
        return ("stats",)

    def curves(self, config: Any) -> tuple[Curve, ...]:
        """Reconstruction, and how the codebooks are used."""
        return tuple(Curve(name) for name in ("recon", "perplexity", "usage", "dead", "resets"))


TOKENIZERS: tuple[tuple[str, str, type[TokenizerStageConfig]], ...] = (
    ("h2vq", "H2VQ tokenizer", H2VQStageConfig),
    ("vq", "VQ tokenizer", VqStageConfig),
    ("rvq", "RVQ tokenizer", RvqStageConfig),
    ("separate", "body and hands apart", SeparateStageConfig),
    ("fsq", "FSQ tokenizer", FsqStageConfig),
    ("mq", "UDE's motion quantization", MqStageConfig),
)
