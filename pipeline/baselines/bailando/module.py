"""Training of Bailando's stages: codes and then the root, the GPT, and the GPT as an actor.

`CrossGptModule` minimises the cross-entropy of upper and lower codes (section 3.2). `ActorCriticModule`
trains the GPT's last layers to keep the beat (section 3.3): it dances to the music of a batch from the first
codes of its motions, and a code is rewarded where a beat of the music and one of the dance both fall into its
frames. Windows of the dances are trained on. The critic reads the states that the GPT's halves share, which
no longer learn, and predicts the reward of the rest of the dance. The advantage, by which a step's reward
exceeds that prediction, weights the cross-entropy of both codes.

Actor and critic take turns of several steps.

Legend: B batch, T frames, L codes, D width.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from motionloom.models.layers.frozen import Frozen, evaluating
from motionloom.models.metrics.dance_beats import motion_beats
from motionloom.models.training.alternating import AlternatingModule, OptimizerGroup
from motionloom.models.training.distributed import masked_mean
from motionloom.models.training.optim import OptimConfig
from motionloom.models.training.stage_module import Batch, StageModule
from motionloom.pipeline.baselines.bailando.codes import HALVES, DanceVq, places
from motionloom.pipeline.baselines.bailando.network import (
    ActorCritic,
    CrossGpt,
    RewardConfig,
    code_errors,
    tiled_causal,
)


def moving_error(made: Tensor, true: Tensor, velocity: float, acceleration: float) -> Tensor:
    """Mean absolute error of [B, T, D], of its steps and of the steps' steps, by weights."""
    difference = made.float() - true.float()
    total = difference.abs().mean()
    for weight in (velocity, acceleration):
        difference = difference.diff(dim=1)
        total = total + weight * difference.abs().mean()
    return total


class DanceVqModule(AlternatingModule):
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
        self.root_optim = root_optim
        self.root_start = root_start

    def optimizer_groups(self) -> list[OptimizerGroup]:
        """The codes, then the root."""
        net = self.net
        start = self.root_start
        return [
            OptimizerGroup("codes", (net.up, net.down), self.optim_config, end_step=start),
            OptimizerGroup("root", (net.root,), self.root_optim, start_step=start),
        ]

    def losses_of(self, group: str, batch: Batch, shared: dict[str, Tensor]) -> dict[str, Tensor]:
        """Losses of {"motion" [B, T, 3 N]}, joints in metres."""
        joints = places(batch["motion"])
        return self._root(joints) if group == "root" else self._codes(joints)

    def _codes(self, joints: Tensor) -> dict[str, Tensor]:
        config = self.net.config
        losses = []
        metrics = dict[str, Tensor]()
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


class CrossGptModule(StageModule):
    """Trains on windows of joints with music; codes are made on the way, by the frozen `DanceVq`."""

    net: CrossGpt

    def __init__(self, net: CrossGpt, optim: OptimConfig, *, seed: int, max_steps: int, vq: DanceVq) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.vq = Frozen(vq)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Losses of "motion" [B, T, 3 N] in metres and "conditions"; rows without music do not count."""
        codes, music, heard = codes_of(self.net, self.vq.module, batch)
        logits = self.net(codes[:, :-1], music[:, 1:])
        true = codes[:, 1:]
        counts = heard[:, None].expand(true.shape[:2])
        each = code_errors(logits, true)
        hits = (logits.argmax(-1) == true).float()
        loss = masked_mean(each.sum(2), counts)
        found = {f"accuracy_{name}": masked_mean(hits[..., k], counts) for k, name in enumerate(HALVES)}
        return {"loss": loss, **found}


def codes_of(gpt: CrossGpt, vq: DanceVq, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    """Codes [B, L, 2] of a batch's joints, the music [B, L, E] of each, and who has music, bool [B]."""
    features, mask, _ = batch["conditions"]["audio"]
    codes = vq.encode(places(batch["motion"]))
    return codes, gpt.heard(features, vq.config.code_frames, codes.shape[1]), mask.any(1)


@dataclass(frozen=True)
class _InTurns(OptimizerGroup):
    """A group with runs of steps, then without."""

    offset: int = 0
    run: int = 1
    period: int = 1

    def steps_at(self, step: int) -> bool:
        return self.offset <= step % self.period < self.offset + self.run


class ActorCriticModule(AlternatingModule):
    """Trains on windows of joints with music and "beats" bool [B, T], frames with a beat of the music."""

    net: ActorCritic
    compilable = False

    def __init__(
        self,
        net: ActorCritic,
        optim: OptimConfig,
        *,
        seed: int,
        max_steps: int,
        vq: DanceVq,
        fps: float,
        reward: RewardConfig,
    ) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.vq = Frozen(vq)
        self.fps = fps
        self.config = reward

    def optimizer_groups(self) -> list[OptimizerGroup]:
        """The actor, then the critic."""
        net = self.net
        actor = self.config.actor_steps
        critic = self.config.critic_steps
        both = actor + critic
        last = (net.gpt.head, net.gpt.out)
        return [
            _InTurns("actor", last, self.optim_config, run=actor, period=both),
            _InTurns("critic", (net.critic,), self.optim_config, offset=actor, run=critic, period=both),
        ]

    def losses_of(self, group: str, batch: Batch, shared: dict[str, Tensor]) -> dict[str, Tensor]:
        """A group's loss, and the mean reward of a code. Neither has dropout, as published."""
        gpt = self.net.gpt
        with evaluating(self.net):
            if "codes" not in shared:
                shared |= self._danced(batch)
            codes, music, reward, heard = (shared[key] for key in ("codes", "music", "reward", "heard"))
            with torch.no_grad():
                states = gpt.states(codes[:, :-1], music[:, 1:])
            error = td_error(reward, self.values(states), self.config.discount)
            if group == "critic":
                loss = masked_mean(error.square(), heard[:, None].expand_as(error))
            else:
                each = code_errors(gpt.logits(states)[:, :-1], codes[:, 1:-1]).sum(2)
                loss = masked_mean(each * error.detach(), shared["counts"])
        return {"loss": loss, "reward": masked_mean(reward, heard[:, None].expand_as(reward))}

    @torch.no_grad()
    def _danced(self, batch: Batch) -> dict[str, Tensor]:
        """Windows of dances as long as the clips: "codes" [B, L, 2], "music" [B, L, E], "reward" [B, L - 2]
        of the codes between the first and the last; "heard" bool [B], who has music; and the codes that the
        actor learns, "counts" bool [B, L - 2].
        """
        gpt = self.net.gpt
        frames = self.vq.module.config.code_frames
        size = self.net.gpt.config.context + 1
        true, music, heard = codes_of(gpt, self.vq.module, batch)
        danced = gpt.dance(true[:, :1], music, self.config.temperature)
        # Each row's window begins anywhere in its clip, so that states far from true codes are trained too.
        room = batch["length"].to(danced.device) // frames - size
        begin = (torch.rand(len(danced), device=danced.device) * (room + 1)).long().clamp(min=0)
        at = begin[:, None] + torch.arange(size, device=danced.device)
        rows = torch.arange(len(danced), device=danced.device)[:, None]
        codes = danced[rows, at]
        # The beats of the rewarded codes' frames.
        steps = at[:, 1:-1, None] * frames + torch.arange(frames, device=at.device)
        reward = self.rewards(codes[:, 1:-1], batch["beats"].to(at.device)[rows, steps.flatten(1)])
        # All codes of a dance's first window, the last of any other: each is learnt with what it can see.
        counts = (begin == 0)[:, None].expand_as(reward).clone()
        counts[:, -1] = True
        return {
            "codes": codes, "music": music[rows, at], "reward": reward, "heard": heard,
            "counts": counts & heard[:, None],
        }  # fmt: skip

    def values(self, states: Tensor) -> Tensor:
        """The critic's, [B, L]: the sum of both halves'."""
        out: Tensor = self.net.critic(states, tiled_causal(states.shape[1] // 3, states.device))
        return out.sum(2)

    def rewards(self, codes: Tensor, beats: Tensor) -> Tensor:
        """[B, L] of codes [B, L, 2] and their frames with a beat of the music [B, T]."""
        joints = self.vq.module.decode(codes).float()
        around = (joints - joints[:, :, :1]).cpu().numpy()
        rows = [
            beat_rewards(one, heard, self.fps, self.vq.module.config.code_frames, self.config.scale)
            for one, heard in zip(around, beats.cpu().numpy(), strict=True)
        ]
        return torch.from_numpy(np.stack(rows)).to(codes.device, torch.float32)


def beat_rewards(
    joints: NDArray[np.floating], beats: NDArray[np.bool_], fps: float, code_frames: int, scale: float
) -> NDArray[np.float64]:
    """scale x (both beats - 1/2) of each code [L], of joints [T, N, 3] and frames with a beat [T]."""
    danced = np.zeros(len(joints), dtype=np.bool_)
    danced[np.round(motion_beats(joints, fps) * fps).astype(int)] = True
    both = [frames.reshape(-1, code_frames).any(1) for frames in (danced, beats[: len(joints)])]
    return np.asarray(scale * ((both[0] & both[1]) - 0.5))


def td_error(reward: Tensor, values: Tensor, discount: float) -> Tensor:
    """Return the codes' advantages, reward above the critic's prediction, [B, L - 1].

    Args:
        reward: [B, L - 1], of the code that follows each state but the last.
        values: [B, L] of the states. Those that follow are a target, without a gradient.
    """
    return reward + discount * values[:, 1:].detach() - values[:, :-1]
