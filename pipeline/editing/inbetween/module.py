"""Training of the in-betweener: as MDM is trained, on motions of which a part is observed."""

from __future__ import annotations

from torch import Tensor

from motionloom.models.diffusion.module import TextDenoiserModule
from motionloom.models.training.distributed import mean_of_rows
from motionloom.models.training.stage_module import Batch, OptimConfig
from motionloom.pipeline.editing.inbetween.network import InBetweener
from motionloom.pipeline.editing.inbetween.observed import Observations


class InBetweenModule(TextDenoiserModule):
    """Trains an `InBetweener`, which observes a part of each motion."""

    net: InBetweener

    def __init__(
        self, net: InBetweener, optim: OptimConfig, *, seed: int, max_steps: int, observations: Observations
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.observations = observations

    def predict(self, noisy: Tensor, step: Tensor, batch: Batch, mask: Tensor) -> Tensor:
        conditions = self.conditions(noisy, step, batch, mask)
        observed = self.observations(batch["motion"], batch["length"])
        predicted: Tensor = self.net(*conditions, observed)
        return predicted

    def mean(self, error: Tensor, mask: Tensor, present: Tensor | None) -> Tensor:
        loss = super().mean(error, mask, present)
        speed_error = mean_of_rows(error.diff(dim=1).square(), mask[:, 1:], present)
        return loss + self.net.config.velocity_weight * speed_error
