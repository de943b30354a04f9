"""Checkpoints of a training: what they hold, and their files, in which every flipped bit is found before use.

Weights and optimizers are stored whole, in the format of one process, also by FSDP: a training may be resumed
with another strategy or number of processes.

A file is what `torch.save` writes, followed by a *seal* of 84 bytes, so that no kill, copy or deletion can
part a checkpoint from its checksum:

    \\nmotionloom sha256 <64 hex digits of everything before it>\\n

The seal finds damage; it is no signature. Whoever can write the file can seal it, so content is only ever
unpickled with `weights_only=True`.
"""

from __future__ import annotations

import hashlib
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, BinaryIO, TypedDict, cast

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

from motionloom.datasets.base.files import HashingFile, atomic_file
from motionloom.datasets.schema import UserError
from motionloom.models.training.averaging import AverageState
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
    average: AverageState | None
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


_SEAL = re.compile(rb"\nmotionloom sha256 ([0-9a-f]{64})\n")
_SEAL_BYTES = 84
_BLOCK = 1 << 20


class DamagedError(Exception):
    """A checkpoint that must not be used; the message is the reason."""


def write_checkpoint(checkpoint: object, path: Path) -> int:
    """Write `checkpoint` and its seal: hashed on the way, synced, then renamed into place; the file's size.

    Raises:
        UserError: The file could not be written (a full disk, most often); nothing half-written stays.
    """
    failure: OSError | None = None
    try:
        with atomic_file(path) as file:
            sink = _Sink(file)
            try:
                torch.save(checkpoint, cast(IO[bytes], sink))
            finally:
                failure = sink.failure
            file.write(b"\nmotionloom sha256 %s\n" % sink.hexdigest.encode())
            return file.tell()
    except (OSError, RuntimeError) as error:
        # torch answers a failed write with an error about its own position in the file.
        cause = error if isinstance(error, OSError) else failure
        if cause is None:
            raise
        raise UserError(_unwritten(path, cause.strerror or str(cause))) from error


def require_written(path: Path, size: int) -> None:
    """Refuse a file that was written without an error and yet is not there with its length and its seal.

    A network file system may lose what it has taken. The bytes between are compared before they are used.

    Raises:
        UserError: It is not there, or shorter, or ends in something else.
    """
    try:
        with path.open("rb") as file:
            sound = file.seek(0, 2) == size
            file.seek(max(0, size - _SEAL_BYTES))
            sound = sound and _SEAL.fullmatch(file.read()) is not None
    except OSError as error:
        raise UserError(_unwritten(path, error.strerror or str(error))) from error
    if not sound:
        raise UserError(_unwritten(path, "what was written is not there when it is read"))


def _unwritten(path: Path, why: str) -> str:
    return (
        f"{path}: the checkpoint cannot be written ({why}); those before it are intact: make room, and start "
        f"the same command again to go on from the newest"
    )


def read_checkpoint(path: Path) -> Checkpoint:
    """Content of a checkpoint that is as it was written; its tensors stay on disk until used.

    Raises:
        DamagedError: It is cut short, changed, or no checkpoint.
    """
    try:
        _check_seal(path)
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except DamagedError:
        raise
    except Exception as error:  # a torn file fails in many ways, all of which mean the same
        raise DamagedError(f"cannot be read ({type(error).__name__})") from None
    if not isinstance(content, dict):
        raise DamagedError(f"holds a {type(content).__name__} and no checkpoint")
    return cast(Checkpoint, content)


def readable(folder: Path, say: Callable[[str], None] = warnings.warn) -> Iterator[tuple[Path, Checkpoint]]:
    """Sound checkpoints of a folder and their content, newest first; `say` is given why others are not."""
    for path in sorted(folder.glob("*.ckpt"), reverse=True):
        try:
            content = read_checkpoint(path)
        except DamagedError as error:
            say(f"{path}: {error}; passed over for the checkpoint before it")
            continue
        yield path, content


class _Sink(HashingFile):
    """A file for `torch.save` that hashes what is written and remembers why it could not be."""

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        self.failure: OSError | None = None

    def write(self, data: bytes) -> int:
        try:
            return super().write(data)
        except OSError as error:
            self.failure = self.failure or error
            raise

    def flush(self) -> None:
        """Nothing: the file is synced before it gets its name."""


def _check_seal(path: Path) -> None:
    with path.open("rb") as file:
        size = file.seek(0, 2) - _SEAL_BYTES
        file.seek(max(0, size))
        seal = _SEAL.fullmatch(file.read())
        if seal is None:
            raise DamagedError("its end with the checksum is cut off or damaged")
        file.seek(0)
        found, block = hashlib.sha256(), memoryview(bytearray(_BLOCK))
        while size > 0:
            count = file.readinto(block[: min(size, _BLOCK)])
            if not count:
                raise DamagedError("became shorter while it was read")
            found.update(block[:count])
            size -= count
    if found.hexdigest().encode() != seal[1]:
        raise DamagedError("the bytes are not those that were written: their sha256 is another")
