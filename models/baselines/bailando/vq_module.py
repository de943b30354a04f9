"""Training of `DanceVq`: both halves first, then the decoder of the root with all else as it is."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from motionloom.models.baselines.bailando.vq import DanceVq, places
from motionloom.models.training.optim import OptimConfig
from motionloom.models.training.players import Player, PlayersModule
from motionloom.models.training.stage_module import Batch


def moving_error(made: Tensor, true: Tensor, velocity: float, acceleration: float) -> Tensor:
    """Mean absolute error of [B, T, D], of its steps and of the steps' steps, by weights."""
    difference = made.float() - true.float()
    total = difference.abs().mean()
    for weight in (velocity, acceleration):
        difference = difference.diff(dim=1)
        total = total + weight * difference.abs().mean()
    return total


class DanceVqModule(PlayersModule):
    """Trains on {"motion" [B, T, 3 N]}, joints in metres.

    Args:
        root_start: First step in which the root's decoder trains and the codes do not.
    """

    net: DanceVq

    def __init__(
        self,
        net: DanceVq,
        optim: OptimConfig,
        *,
        seed: int,
        max_steps: int,
        root_optim: OptimConfig,
        root_start: int,
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.root_optim, self.root_start = root_optim, root_start

    def players(self) -> list[Player]:
        """The codes, then the root."""
        net, start = self.net, self.root_start
        return [
            Player("codes", (net.up, net.down), self.optim_config, end_step=start),
            Player("root", (net.root,), self.root_optim, start_step=start),
        ]

    def play(self, player: str, batch: Batch, shared: dict[str, Tensor]) -> dict[str, Tensor]:
        """Losses of {"motion" [B, T, 3 N]}, joints in metres."""
        joints = places(batch["motion"])
        return self._root(joints) if player == "root" else self._codes(joints)

    def _codes(self, joints: Tensor) -> dict[str, Tensor]:
        config, losses, metrics = self.net.config, [], dict[str, Tensor]()
        for name, out in self.net(joints).items():
            weights = config.velocity_weight, config.acceleration_weight
            error = moving_error(out.reconstruction, out.input, *weights)
            losses.append(error + config.commitment_weight * out.penalty)
            metrics[f"recon_{name}"] = functional.l1_loss(out.reconstruction.float(), out.input.float())
            metrics |= {f"{metric}_{name}": value for metric, value in out.metrics.items()}
        return {"loss": torch.stack(losses).mean(), **metrics}

    def _root(self, joints: Tensor) -> dict[str, Tensor]:
        root = joints[:, :, 0]
        made = self.net.steps(self.net.encode(joints)[..., 1])[:, :-1]
        loss = moving_error(made, root.diff(dim=1), self.net.config.acceleration_weight, 0.0)
        still = root.diff(dim=1).abs().mean()
        return {"loss": loss, "still": still}
