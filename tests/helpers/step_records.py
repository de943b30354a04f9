"""What a training step was, for tests that compare steps: a digest of its batch and the bits of every loss.

`watch_steps` wraps two methods of the modules in this process and its forks; the product knows nothing of it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

RECORDS = "KILL_MATRIX_RECORDS"
"""Where the ranks of a try write their lines: a folder."""

PAUSE = "KILL_MATRIX_PAUSE"
"""Seconds that a step sleeps, for trainings that are to be met in the middle."""


def watch_steps() -> None:
    """Have every training step of this process and its forks leave a line in the folder of RECORDS."""
    from motionloom.models.training.distributed import rank
    from motionloom.models.training.stage_module import StageModule
    from motionloom.pipeline.training.trainer import Training

    average, start, end = StageModule.average, Training.on_train_batch_start, Training.on_train_batch_end
    figures: dict[str, str] = {}
    batches: list[Any] = []

    def averaged(self: Any, values: Any) -> None:
        figures.update({name: float(value.detach()).hex() for name, value in values.items()})
        average(self, values)

    def started(self: Any, trainer: Any, module: Any, batch: Any, number: int) -> None:
        batches.append(batch)
        start(self, trainer, module, batch, number)

    def ended(self: Any, trainer: Any, module: Any, *rest: Any) -> None:
        if module.step > self._step:
            time.sleep(float(os.environ.get(PAUSE, 0)))
            digest = _digest(batches[0] if len(batches) == 1 else batches)
            restarts = int(os.environ.get("SLURM_RESTART_COUNT", 0))
            row = {"step": module.step - 1, "start": restarts, "batch": digest}
            _leave(rank(), row | {"figures": dict(figures)})
            figures.clear()
            batches.clear()
        end(self, trainer, module, *rest)

    StageModule.average = averaged  # type: ignore[method-assign]
    Training.on_train_batch_start = started  # type: ignore[method-assign]
    Training.on_train_batch_end = ended  # type: ignore[method-assign]


def _digest(batch: Any) -> str:
    """sha256 of every tensor and every other value of a batch, by its place in it."""
    import torch

    found = hashlib.sha256()

    def add(value: Any, where: str) -> None:
        if isinstance(value, dict):
            for name in sorted(value):
                add(value[name], f"{where}.{name}")
        elif isinstance(value, list | tuple):
            for number, one in enumerate(value):
                add(one, f"{where}.{number}")
        elif dataclasses.is_dataclass(value):
            add(vars(value), where)
        else:
            tensor = isinstance(value, torch.Tensor)
            raw = value.detach().contiguous().numpy().tobytes() if tensor else repr(value).encode()
            found.update(f"\n{where} {getattr(value, 'shape', '')}\n".encode() + raw)

    add(batch, "")
    return found.hexdigest()[:16]


def _leave(rank: int, row: dict[str, Any]) -> None:
    """One write, which SIGKILL cannot take back or tear."""
    folder = os.environ[RECORDS]
    handle = os.open(f"{folder}/{rank}.jsonl", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    try:
        os.write(handle, json.dumps(row).encode() + b"\n")
    finally:
        os.close(handle)


def rows_of(records: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """(rank, line) of all that a try has left."""
    for path in sorted(records.glob("*.jsonl")):
        for line in path.read_text().splitlines():
            yield int(path.stem), json.loads(line)
