"""Training with several optimizers: groups that take turns in every step, such as a generator and a critic.

A step gives each group its turn, in order: its gradients over all parts of the batch, their mean over ranks,
clipping, one step of its optimizer. The next group sees the weights that the last one has stepped to, with
accumulation too, so parts equal the whole batch where they do with one optimizer. Steps are counted once,
however many optimizers step, so batches, seeds, schedules, checkpoints and logs go by training steps.

Gradients are averaged over ranks here and not by DDP: its reducer waits for a gradient of every parameter in
every backward pass, and a group's pass reaches its own alone.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn
from torch.optim import Optimizer

from motionloom.models.training.compiled import Compiled
from motionloom.models.training.distributed import mean_gradients
from motionloom.models.training.optim import OptimConfig
from motionloom.models.training.stage_module import Batch, StageModule, StepSchedule


@dataclass(frozen=True)
class OptimizerGroup:
    """Networks that one optimizer trains, and the steps in which it does."""

    name: str
    nets: tuple[nn.Module, ...]
    optim: OptimConfig
    every: int = 1
    """The group takes a turn in every so many steps."""
    start_step: int = 0
    """First step with a turn; its warm-up and schedule begin there."""
    end_step: int | None = None
    """First step without a turn any more; its schedule ends there (None = with the training)."""

    def steps_at(self, step: int) -> bool:
        """Return whether the group has a turn in a step."""
        over = self.end_step is not None and step >= self.end_step
        return not over and step >= self.start_step and (step - self.start_step) % self.every == 0

    def params(self) -> list[nn.Parameter]:
        return [p for net in self.nets for p in net.parameters() if p.requires_grad]

    def factor(self, step: int, *, max_steps: int) -> float:
        """Return the factor of the learning rate in a step of a training of `max_steps`."""
        end = max_steps if self.end_step is None else self.end_step
        return self.optim.factor(max(0, step - self.start_step), end - self.start_step)


class _Turn(NamedTuple):
    """A group with what trains it."""

    group: OptimizerGroup
    params: list[nn.Parameter]
    optimizer: Optimizer
    schedule: StepSchedule


class AlternatingModule(StageModule):
    """Trains networks of several groups. Subclasses implement `optimizer_groups()` and `losses_of(...)`.

    `net` is the network that the stage saves. The others are further attributes of the module: they are in
    its checkpoints, and not in the saved model.
    """

    def __init__(self, net: nn.Module, optim: OptimConfig, *, seed: int, max_steps: int) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self.automatic_optimization = False
        self._turns: list[_Turn] = []
        self._parts: list[Batch] = []
        """Parts of the step that is being collected."""

    @abstractmethod
    def optimizer_groups(self) -> Sequence[OptimizerGroup]:
        """Return the groups in the order of their turns; no parameter may belong to two."""

    @abstractmethod
    def losses_of(self, group: str, batch: Batch, shared: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return a group's losses and metrics on one batch: "loss" is minimised, the others are only logged.

        `shared` is empty in the first turn on a batch. Tensors that a group puts there reach the later groups
        detached: a critic judges the generator's output without a second forward pass. They are missing where
        that group had no turn.
        """

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return figures of all groups, scalars [], under GROUP_NAME, and the first one's loss as "loss"."""
        shared: dict[str, Tensor] = {}
        out: dict[str, Tensor] = {}
        for group in self.optimizer_groups():
            values = self.losses_of(group.name, batch, shared)
            shared = {name: value.detach() for name, value in shared.items()}
            out = out or {"loss": values["loss"]}
            out |= _named(group, values)
        return out

    def compile_losses(self, *, graphs: bool = False) -> None:
        """As the base class; groups share tensors, so that no graph may be replayed over them."""
        self.losses_of = Compiled(self.losses_of, self.net)  # type: ignore[assignment]

    def configure_optimizers(self) -> list[OptimizerLRSchedulerConfig]:
        """Return an optimizer and a schedule for each group; a turn sets its rate from the step's number."""
        groups = self.optimizer_groups()
        trained = [group.params() for group in groups]
        every = [id(param) for params in trained for param in params]
        if len(every) != len(set(every)):
            raise ValueError("a parameter belongs to two groups")
        self._turns = []
        steps = self.length_of_training()
        for group, params in zip(groups, trained, strict=True):
            optimizer = group.optim.build(params)
            schedule = StepSchedule(optimizer, partial(group.factor, max_steps=steps))
            self._turns.append(_Turn(group, params, optimizer, schedule))
        return [
            {"optimizer": turn.optimizer, "lr_scheduler": {"scheduler": turn.schedule, "interval": "step"}}
            for turn in self._turns
        ]

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor | None:
        """Collect a part of the step; with the last one, let every group that has a turn take it.

        Return the first group's loss on the first part, detached; None before the last part.
        """
        self._parts.append(batch)
        if len(self._parts) < self.accumulate:
            return None
        parts = self._parts
        self._parts = []
        # The mean over ranks is taken in every turn; a Trainer's DDP must not wait for gradients as well.
        strategy = None if self._trainer is None else self._trainer.strategy
        with getattr(strategy, "block_backward_sync", nullcontext)():
            loss = self._take_turns(parts)
        if self._trainer is not None:  # which otherwise counts the steps of all optimizers
            steps = self._trainer.fit_loop.epoch_loop.manual_optimization.optim_step_progress
            steps.increment_ready()
            steps.increment_completed()
        return loss

    def _take_turns(self, parts: list[Batch]) -> Tensor:
        shared: list[dict[str, Tensor]] = [{} for _ in parts]
        self.gauges = {}
        first = None
        for number, turn in enumerate(self._turns):
            if not turn.group.steps_at(self.step):
                continue
            with self._train_only(turn):
                turn.optimizer.zero_grad()
                for place, part in enumerate(parts):
                    self.seed_draws(place, number)
                    loss = self._backward(turn.group, part, shared[place], first=number == 0)
                    first = loss if first is None else first
                # Outside of autocast, as the steps of one optimizer are.
                with torch.autocast(self.device.type, enabled=False):
                    self._step_of(turn)
        return torch.zeros(()) if first is None else first

    def _backward(
        self, group: OptimizerGroup, part: Batch, shared: dict[str, Tensor], *, first: bool
    ) -> Tensor:
        """Add the gradients of a group's loss on a part; returns the loss."""
        with self.reading(part):
            values = self.losses_of(group.name, part, shared)
        shared.update({name: value.detach() for name, value in shared.items()})
        named = _named(group, values)
        self.record({"loss": values["loss"], **named} if first else named, part)
        with torch.autocast(self.device.type, enabled=False):
            self.manual_backward(values["loss"] / self.accumulate)
        return values["loss"].detach()

    def _step_of(self, turn: _Turn) -> None:
        """Average and clip a group's gradients and step its optimizer, if it has any gradient."""
        group = turn.group
        optimizer = turn.optimizer
        mean_gradients(turn.params)
        if all(param.grad is None for param in turn.params):
            return
        rate = turn.schedule.set_step(self.step)
        norm = self.clip(turn.params, group.optim.grad_clip)
        if norm is not None:
            self.gauges |= {f"lr/{group.name}": rate, f"grad_norm/{group.name}": norm}
        optimizer.step()

    @contextmanager
    def _train_only(self, turn: _Turn) -> Iterator[None]:
        """Context in which parameters of other groups get no gradients; those of no group are not touched."""
        others = [param for other in self._turns if other is not turn for param in other.params]
        for param in others:
            param.requires_grad_(False)
        try:
            yield
        finally:
            for param in others:
                param.requires_grad_(True)


def _named(group: OptimizerGroup, values: dict[str, Tensor]) -> dict[str, Tensor]:
    return {f"{group.name}_{name}": value for name, value in values.items()}
