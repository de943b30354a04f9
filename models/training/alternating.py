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
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from motionloom.models.training.distributed import mean_gradients
from motionloom.models.training.optim import OptimConfig
from motionloom.models.training.stage_module import Batch, Execution, StageModule


@dataclass(frozen=True)
class OptimizerGroup:
    """Networks that one optimizer trains, and the steps in which it does."""

    name: str
    nets: tuple[nn.Module, ...]
    optim: OptimConfig
    every: int = 1
    """Steps from one turn to the next."""
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


class AlternatingModule(StageModule):
    """Trains networks of several groups. Subclasses implement `optimizer_groups()` and `losses_of(...)`.

    `net` is the network that the stage saves. The others are further attributes of the module: they are in
    its checkpoints, and not in the saved model.
    """

    def __init__(self, net: nn.Module, optim: OptimConfig, *, seed: int, max_steps: int) -> None:
        super().__init__(net, optim, seed=seed, max_steps=max_steps)
        self._trained: list[list[nn.Parameter]] = []

    @abstractmethod
    def optimizer_groups(self) -> Sequence[OptimizerGroup]:
        """The groups in the order of their turns; no parameter may belong to two."""

    @abstractmethod
    def losses_of(self, group: str, batch: Batch, shared: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return a group's losses and metrics on one batch: "loss" is minimised, the others are only logged.

        `shared` is empty in the first turn on a batch. What a group puts there the next ones get, without
        its gradient: a critic judges what the generator has made instead of having it made again. A group
        whose forerunner had no turn must do without it.
        """

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Figures of all groups, each under its name, and the first one's loss as "loss" (validation)."""
        shared: dict[str, Tensor] = {}
        out: dict[str, Tensor] = {}
        for group in self.optimizer_groups():
            values = self.losses_of(group.name, batch, shared)
            shared = {name: value.detach() for name, value in shared.items()}
            out = out or {"loss": values["loss"]}
            out |= _named(group, values)
        return out

    def compile_losses(self) -> None:
        torch.compiler.reset()
        self.losses_of = torch.compile(self.losses_of, fullgraph=True)  # type: ignore[method-assign]

    def configure_optimizers(self) -> list[Optimizer]:
        """One optimizer a group; learning rates are set in every turn, as a function of the step."""
        groups = self.optimizer_groups()
        self._trained = [group.params() for group in groups]
        every = [id(param) for params in self._trained for param in params]
        if len(every) != len(set(every)):
            raise ValueError("a parameter belongs to two groups")
        return [
            group.optim.build(params, fused=self.fused)
            for group, params in zip(groups, self._trained, strict=True)
        ]

    def take_step(self, parts: Iterable[Batch], optimizers: list[Optimizer], how: Execution) -> Tensor:
        """One step: every group that has a turn takes it. The first one's loss on the first part."""
        batches = list(parts)
        shared: list[dict[str, Tensor]] = [{} for _ in batches]
        self.gauges, first, stepped = {}, None, False
        for turn, (group, optimizer) in enumerate(zip(self.optimizer_groups(), optimizers, strict=True)):
            if not group.steps_at(self.step):
                continue
            with self._alone_trains(turn):
                optimizer.zero_grad()
                for number, part in enumerate(batches):
                    loss = self._backward(group, turn, number, part, shared, how)
                    first = loss if first is None else first
                stepped |= self._step(group, turn, optimizer, how)
        if how.scaler is not None and stepped:
            how.scaler.update()
        self.step += 1
        return torch.zeros(()) if first is None else first

    def _backward(
        self,
        group: OptimizerGroup,
        turn: int,
        number: int,
        part: Batch,
        shared: list[dict[str, Tensor]],
        how: Execution,
    ) -> Tensor:
        self.seed_draws(number, turn)
        with how.autocast():
            values = self.losses_of(group.name, part, shared[number])
        shared[number] = {name: value.detach() for name, value in shared[number].items()}
        named = _named(group, values)
        self.average({"loss": values["loss"], **named} if turn == 0 else named)
        how.fabric.backward(values["loss"] / self.accumulate)
        return values["loss"].detach()

    def _step(self, group: OptimizerGroup, turn: int, optimizer: Optimizer, how: Execution) -> bool:
        """A group's step with the gradients that it has; False if it has none."""
        params = self._trained[turn]
        mean_gradients(params)
        if all(param.grad is None for param in params):
            return False
        step = self.step - group.start_step
        end = self.max_steps if group.end_step is None else group.end_step
        rate = group.optim.lr * group.optim.factor(step, end - group.start_step)
        for settings in optimizer.param_groups:
            settings["lr"] = rate
        if how.scaler is not None:
            how.scaler.unscale_(optimizer)
        norm = self.clip(params, group.optim.grad_clip)
        if norm is not None:
            self.gauges |= {f"lr/{group.name}": rate, f"grad_norm/{group.name}": norm}
        how.step(optimizer)
        return True

    @contextmanager
    def _alone_trains(self, turn: int) -> Iterator[None]:
        """Inside, no other group's parameters get gradients; those of none of them are left as they are."""
        others = [p for other, params in enumerate(self._trained) if other != turn for p in params]
        for param in others:
            param.requires_grad_(False)
        try:
            yield
        finally:
            for param in others:
                param.requires_grad_(True)


def _named(group: OptimizerGroup, values: dict[str, Tensor]) -> dict[str, Tensor]:
    return {f"{group.name}_{name}": value for name, value in values.items()}
