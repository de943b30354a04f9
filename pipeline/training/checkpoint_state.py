"""What a checkpoint of a training holds, and how it is taken from the training and given back.

Weights and optimizers are stored whole, in the format of one process, also by FSDP: a training may be resumed
with another strategy or number of processes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypedDict, cast

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributed.checkpoint.state_dict import (
    StateDictOptions,
    get_model_state_dict,
    get_optimizer_state_dict,
    set_model_state_dict,
    set_optimizer_state_dict,
)
from torch.distributed.tensor import DTensor
from torch.optim import Optimizer

from motionloom.models.training.distributed import rank, world_size
from motionloom.models.training.stage_module import Means, StageModule
from motionloom.pipeline.training.progress import LogState

OptimizerState = dict[str, Any]
"""As `Optimizer.state_dict` gives it."""


class Checkpoint(TypedDict):
    """Everything a training needs to continue after a step."""

    global_step: int
    steps: int
    """Steps of the training that wrote it."""
    state_dict: dict[str, Tensor]
    optimizer_states: list[OptimizerState]
    scaler: dict[str, object]
    average: dict[str, Tensor] | None
    log: LogState
    row: list[list[Means]]
    """Means of the log's next row so far, of each rank."""
    validate: bool
    """Whether a signal cut the validation of this step short: the resumed training begins with it."""


def weights_of(module: StageModule) -> dict[str, Tensor]:
    """Weights and buffers; of FSDP gathered on rank 0, a collective."""
    if _is_sharded(module):
        return cast(dict[str, Tensor], get_model_state_dict(module, options=_WHOLE))
    return dict(module.state_dict())


def load_weights(module: StageModule, state: dict[str, Tensor]) -> None:
    """Undo `weights_of`."""
    if _is_sharded(module):
        set_model_state_dict(
            module, cast(dict[str, Any], state), options=StateDictOptions(full_state_dict=True)
        )
    else:
        module.load_state_dict(state)


def optimizer_state(module: StageModule, optimizer: Optimizer) -> OptimizerState:
    """State with parameters by number; of FSDP gathered on rank 0, a collective."""
    if not _is_sharded(module):
        return optimizer.state_dict()
    whole = cast(OptimizerState, get_optimizer_state_dict(module, optimizer, options=_WHOLE))
    if not whole:
        return {}
    return _renamed(whole, {name: number for number, name in enumerate(_names(module, optimizer))})


def load_optimizer(module: StageModule, optimizer: Optimizer, state: OptimizerState) -> None:
    """Undo `optimizer_state`."""
    if not _is_sharded(module):
        optimizer.load_state_dict(state)
        return
    named = _renamed(state, dict(enumerate(_names(module, optimizer))))
    set_optimizer_state_dict(module, optimizer, named, options=StateDictOptions(full_state_dict=True))


def _renamed(state: OptimizerState, names: Mapping[str, int] | Mapping[int, str]) -> OptimizerState:
    """The state with other keys for its parameters."""
    groups = [{**one, "params": [names[key] for key in one["params"]]} for one in state["param_groups"]]
    return {"state": {names[key]: values for key, values in state["state"].items()}, "param_groups": groups}


def rows_of_ranks(module: StageModule) -> list[list[Means]]:
    """What each rank has added to the next row of the log; a collective."""
    rows = [module.row_state()] * world_size()
    if world_size() > 1:
        dist.all_gather_object(rows, module.row_state())
    return rows


def load_row(module: StageModule, rows: Sequence[list[Means]]) -> None:
    """Continue the log's row; with another number of ranks each takes the mean of all."""
    if len(rows) == world_size():
        module.load_row(rows[rank()])
        return
    module.load_row(
        [
            {**means, "sums": torch.stack([row[place]["sums"] for row in rows]).mean(0)}
            for place, means in enumerate(rows[0])
        ]
    )


_WHOLE = StateDictOptions(full_state_dict=True, cpu_offload=True)


def _is_sharded(module: nn.Module) -> bool:
    return any(isinstance(param, DTensor) for param in module.parameters())


def _names(module: nn.Module, optimizer: Optimizer) -> list[str]:
    """Names of an optimizer's parameters, in its order."""
    names = {id(param): name for name, param in module.named_parameters()}
    return [names[id(param)] for group in optimizer.param_groups for param in group["params"]]
