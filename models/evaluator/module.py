"""Training of the evaluator (Guo et al., CVPR 2022): movements by an autoencoder, then the pairs."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from motionloom.models.evaluator.losses import (
    MATCHING,
    MOVEMENT,
    EvaluatorLossConfig,
    matching_loss,
    movement_loss,
)
from motionloom.models.evaluator.network import UNIT, Evaluator
from motionloom.models.training.alternating import AlternatingModule, OptimizerGroup
from motionloom.models.training.optim import OptimConfig
from motionloom.models.training.stage_module import Batch


class EvaluatorModule(AlternatingModule):
    """Trains an `Evaluator` on captioned `ConditionBatches`.

    For the first `movement_steps` the movement encoder is trained with a decoder that no latent needs, from
    then on the two GRUs on units that stay as they are.
    """

    net: Evaluator
    compilable = False

    def __init__(
        self,
        net: Evaluator,
        optim: OptimConfig,
        *,
        seed: int,
        max_steps: int,
        movement_optim: OptimConfig,
        movement_steps: int,
        loss: EvaluatorLossConfig | None = None,
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.decoder = net.decoder()
        self.movement_optim = movement_optim
        self.movement_steps = movement_steps
        self.loss_config = loss or EvaluatorLossConfig()

    def optimizer_groups(self) -> Sequence[OptimizerGroup]:
        """The movement encoder first, then the pairs; not in turn."""
        net = self.net
        texts = (
            (net.text_encoder,) if net.class_embedding is None else (net.text_encoder, net.class_embedding)
        )
        return (
            OptimizerGroup(
                MOVEMENT,
                (net.movement_encoder, self.decoder),
                self.movement_optim,
                end_step=self.movement_steps,
            ),
            OptimizerGroup(
                MATCHING, (net.motion_encoder, *texts), self.optim_config, start_step=self.movement_steps
            ),
        )

    def losses_of(self, group: str, batch: Batch, shared: dict[str, Tensor]) -> dict[str, Tensor]:
        """Losses of "motion" [B, T, D], "length" [B], "conditions" with "text", optional "present" [B, D]."""
        net = self.net
        motion = batch["motion"]
        length = batch["length"]
        present = batch.get("present")
        if group == MATCHING:
            text = batch["conditions"]["text"]
            latents = net.encode_text(text.features, text.mask), net.encode_motion(motion, length, present)
            return matching_loss(*latents, margin=self.loss_config.margin)
        target, count = net.whole_units(motion, length, present)
        target = target[:, : target.shape[1] // UNIT * UNIT]
        units = net.movement_encoder(target[..., net.read_columns], dropout=True)
        return movement_loss(self.decoder(units), target, units, count, present, config=self.loss_config)
