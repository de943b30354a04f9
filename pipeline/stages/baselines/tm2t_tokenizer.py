"""TM2T's own tokenizer, against a critic of what it makes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from motionloom.models.baselines.tm2t.losses import CriticConfig
from motionloom.models.tokenizer.base import Tokenizer
from motionloom.models.tokenizer.config import Tm2tConfig
from motionloom.models.tokenizer.tm2t import Tm2tQuantizer, tm2t_names
from motionloom.models.training.optim import OptimConfig
from motionloom.pipeline.contract.showing import Curve
from motionloom.pipeline.contract.stage import register
from motionloom.pipeline.stages.networks.tokenizer import (
    TokenizerInputs,
    TokenizerStage,
    TokenizerStageConfig,
)
from motionloom.pipeline.store.weights import Release
from motionloom.pipeline.training.config import TrainConfig

if TYPE_CHECKING:
    from motionloom.models.training.stage_module import StageModule


class Tm2tStageConfig(TokenizerStageConfig):
    """TM2T's tokenizer; the defaults are the published ones but for the steps."""

    net: Tm2tConfig = Tm2tConfig()
    critic: CriticConfig = CriticConfig()
    optim: OptimConfig = OptimConfig(optimizer="adam", lr=1e-4, betas=(0.9, 0.999), grad_clip=0.0)
    train: TrainConfig = TrainConfig(steps=100_000, batch_size=128)


class Tm2tStage(TokenizerStage):
    """A tokenizer and its critic, which take turns."""

    curves = tuple(
        Curve(name)
        for name in ("tokenizer_recon", "tokenizer_adversarial", "tokenizer_perplexity", "critic_accuracy")
    )

    def release(self, net: Tokenizer) -> Release:
        """TM2T's, without the critic."""
        assert isinstance(net, Tm2tQuantizer)
        return Release(tm2t_names(net))

    def module(
        self, config: TokenizerStageConfig, net: Tokenizer, inputs: TokenizerInputs, seed: int
    ) -> StageModule:
        from motionloom.models.baselines.tm2t.critic import CriticisedModule

        assert isinstance(config, Tm2tStageConfig) and isinstance(net, Tm2tQuantizer)
        steps = config.train.steps
        return CriticisedModule(net, config.optim, seed=seed, max_steps=steps, critic=config.critic)


register(Tm2tStage("tm2t", "TM2T's tokenizer", Tm2tStageConfig))
