"""A training loop by hand, what any Trainer must come to; and such a Trainer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import lightning as L
import torch
from lightning.fabric import Fabric
from torch import Tensor

from motionloom.models.training.stage_module import Batch, StageModule

Precision = Literal["32-true", "bf16-mixed"]


def take_steps(
    module: StageModule, batches: Sequence[Batch], precision: Precision = "32-true"
) -> list[Tensor]:
    """One step for every `module.accumulate` batches; the losses of all."""
    module.fabric = Fabric(accelerator="cpu")  # with which modules of several optimizers go backwards
    optimizer, losses = module.configure_optimizers()[0]["optimizer"], []
    for number, batch in enumerate(batches):
        part = number % module.accumulate
        if part == 0 and module.automatic_optimization:
            module.schedule.set_step(module.step)
            optimizer.zero_grad()  # type: ignore[union-attr]

        def gradients(batch: Batch = batch, part: int = part) -> Tensor:
            half = precision == "bf16-mixed"
            with torch.autocast("cpu", torch.bfloat16, enabled=half, cache_enabled=False):
                loss = module.training_step(batch, part)
            if module.automatic_optimization and loss is not None:
                (loss / module.accumulate).backward()
            return torch.zeros(()) if loss is None else loss.detach()

        losses.append(module.without_failed_graph(gradients))
        if part == module.accumulate - 1:
            if module.automatic_optimization:
                module.configure_gradient_clipping(optimizer)  # type: ignore[arg-type]
                optimizer.step()  # type: ignore[union-attr,call-arg]
            module.step += 1
    return losses


def trainer(folder: Path, **settings: Any) -> L.Trainer:
    """A Trainer of six steps that prints and logs nothing."""
    quiet: dict[str, Any] = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    base = {"max_steps": 6, "accelerator": "cpu", "default_root_dir": folder, **quiet, **settings}
    return L.Trainer(**{"enable_checkpointing": False, **base})


class StopAt(L.Callback):
    """Ends a training at a step, as what watches it may; saves it there if told where."""

    def __init__(self, step: int, path: Path | None = None) -> None:
        self.step, self.path = step, path

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        trainer.should_stop = trainer.global_step == self.step
        if trainer.should_stop and self.path is not None:
            trainer.save_checkpoint(self.path)
