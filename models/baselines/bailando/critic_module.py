"""Actor-critic training of a `CrossGpt` by how well its dances keep the beat (Bailando, section 3.3).

The actor is the GPT. It dances to the music of a batch from the first codes of its motions; a code is worth
more where both a beat of the music and one of the dance fall into its frames. The critic reads the states
that the GPT's halves share, without a gradient to them, and says what the rest of a dance will be worth.
What a code was worth more than that weighs its cross-entropy.

Actor and critic take turns of several steps. Codes are drawn from the actor [ours]: of the likeliest ones it
would see nothing else.

Legend: B batch, T frames, L codes, D width.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from motionloom.models.baselines.bailando.critic import ActorCritic, RewardConfig
from motionloom.models.baselines.bailando.gpt import code_errors, tiled_causal
from motionloom.models.baselines.bailando.gpt_module import codes_of
from motionloom.models.baselines.bailando.vq import DanceVq
from motionloom.models.gpt.frozen import Frozen, evaluating
from motionloom.models.metrics.dance_beats import motion_beats
from motionloom.models.training.distributed import masked_mean
from motionloom.models.training.optim import OptimConfig
from motionloom.models.training.players import Player, PlayersModule
from motionloom.models.training.stage_module import Batch


@dataclass(frozen=True)
class _InTurns(Player):
    """A player with runs of steps, then without."""

    offset: int = 0
    run: int = 1
    period: int = 1

    def plays(self, step: int) -> bool:
        return self.offset <= step % self.period < self.offset + self.run


class ActorCriticModule(PlayersModule):
    """Trains on windows of joints with music and "beats" bool [B, T], frames with a beat of the music."""

    net: ActorCritic

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
        self.vq, self.fps, self.config = Frozen(vq), fps, reward

    def players(self) -> list[Player]:
        """The actor, then the critic."""
        net, actor, critic = self.net, self.config.actor_steps, self.config.critic_steps
        both = actor + critic
        return [
            _InTurns("actor", (net.gpt,), self.optim_config, run=actor, period=both),
            _InTurns("critic", (net.critic,), self.optim_config, offset=actor, run=critic, period=both),
        ]

    def play(self, player: str, batch: Batch, shared: dict[str, Tensor]) -> dict[str, Tensor]:
        """A player's loss, and the mean reward of a code."""
        gpt = self.net.gpt
        true, music, heard = codes_of(gpt, self.vq.module, batch)
        if "codes" not in shared:
            with evaluating(gpt):
                codes = gpt.dance(true[:, :1], music, self.config.temperature)
            shared |= {"codes": codes, "reward": self.rewards(codes, batch["beats"])}
        codes, reward = shared["codes"], shared["reward"][:, 1:]
        counts = heard[:, None].expand_as(reward)
        states = gpt.states(codes[:, :-1], music[:, 1:])
        error = td_error(reward, self.values(states.detach()), self.config.discount)
        some = counts[:, :-1]
        if player == "critic":
            loss = masked_mean(error.square().mean(2), some)
        else:
            each = code_errors(gpt.logits(states), codes[:, 1:])[:, :-1]
            loss = masked_mean((each * error.detach()).sum(2), some)
        return {"loss": loss, "reward": masked_mean(reward, counts)}

    def values(self, states: Tensor) -> Tensor:
        """The critic's, [B, L, 2]."""
        out: Tensor = self.net.critic(states, tiled_causal(states.shape[1] // 3, states.device))
        return out

    def rewards(self, codes: Tensor, beats: Tensor) -> Tensor:
        """[B, L] of codes [B, L, 2] and frames with a beat of the music [B, T]."""
        joints = self.vq.module.decode(codes).cpu().numpy()
        rows = [
            beat_rewards(one, heard, self.fps, self.vq.module.config.code_frames, self.config.scale)
            for one, heard in zip(joints, beats.cpu().numpy(), strict=True)
        ]
        return torch.from_numpy(np.stack(rows)).to(codes.device, torch.float32)


class Unrewarded(ActorCriticModule):
    """For dry runs, whose tensors hold no numbers that a dance could be made of."""

    def rewards(self, codes: Tensor, beats: Tensor) -> Tensor:
        """Nothing."""
        return torch.zeros(codes.shape[:2], device=codes.device)


def beat_rewards(
    joints: NDArray[np.floating], beats: NDArray[np.bool_], fps: float, code_frames: int, scale: float
) -> NDArray[np.float64]:
    """scale x (both beats - 1/2) of each code [L], of joints [T, N, 3] and frames with a beat [T]."""
    danced = np.zeros(len(joints), dtype=np.bool_)
    danced[np.round(motion_beats(joints, fps) * fps).astype(int)] = True
    both = [frames.reshape(-1, code_frames).any(1) for frames in (danced, beats[: len(joints)])]
    return np.asarray(scale * ((both[0] & both[1]) - 0.5))


def td_error(reward: Tensor, values: Tensor, discount: float) -> Tensor:
    """What codes were worth more than the critic said, [B, L - 1, 2].

    Args:
        reward: [B, L], of the code that follows each state.
        values: [B, L, 2] of the states. Those that follow get a gradient as well: undiscounted and never
            told an end, values have no level, and only their differences are learnt.
    """
    return reward[:, :-1, None] + discount * values[:, 1:] - values[:, :-1]
