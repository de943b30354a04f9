"""Repeating the steps up to a failure: what each of them gave, and whether it fails again."""

from __future__ import annotations

import math
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor, nn

from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.flight.groups import LayerGroups, group_of, read_norms
from motionloom.pipeline.flight.watch import Watch
from motionloom.pipeline.store.crash import flat_batch


class ReplayDone(Exception):  # noqa: N818 (it ends a replay, and is no failure)
    """The step has been repeated."""


class ReplaySteps(Callback):
    """Stands in for the flight recorder while a training is repeated up to step `step`, and ends it there."""

    def __init__(self, step: int, accumulate: int, *, anomaly: bool) -> None:
        self.step, self.accumulate, self.anomaly = step, accumulate, anomaly
        self.figures: dict[int, dict[str, list[float]]] = {}
        """Of each step that was repeated."""
        self.norms: dict[str, float] = {}
        """Gradient norms by layer group of the last step."""
        self.batch: dict[str, Tensor] = {}
        """The last step's, flat."""
        self.first_layers: list[str] = []
        """Layers whose output was not finite though their input was, in the order of the forward pass."""
        self.first = 0
        """The checkpoint's step."""
        self.lost: list[str] = []
        """Layer groups whose weights are not finite before the last step."""
        self._watch: _AllNorms | None = None
        self._hooks: list[Any] = []

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Look on."""
        assert isinstance(pl_module, StageModule)
        self.first = trainer.global_step
        scaled = getattr(trainer.precision_plugin, "scaler", None) is not None
        self._watch = pl_module.watcher = _AllNorms(pl_module, keep=self.step + 1, scaled=scaled)

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Keep the last batch; with `anomaly`, have torch look into that step."""
        if trainer.global_step + 1 < self.step:
            return
        part = batch_idx % self.accumulate
        self.batch |= flat_batch(batch, f"part{part}" if self.accumulate > 1 else "")
        if part == 0:
            weights = LayerGroups(pl_module).weight_norms(pl_module.parameters())
            self.lost = [name for name, norm in read_norms(weights).items() if not math.isfinite(norm)]
            if self.anomaly:
                torch.autograd.set_detect_anomaly(True, check_nan=True)
                self._hook(pl_module)

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """End behind the last step."""
        if trainer.global_step >= self.step:
            raise ReplayDone

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Read what was seen, however it ended."""
        torch.autograd.set_detect_anomaly(False)
        for hook in self._hooks:
            hook.remove()
        self._hooks = []
        if self._watch is not None:
            self._watch.read()
            self.figures = dict(self._watch.recent)
            self.norms = read_norms(self._watch.all_norms)

    def _hook(self, module: nn.Module) -> None:
        for name, layer in module.named_modules():
            if name and not any(layer.children()):
                self._hooks.append(layer.register_forward_hook(self._looker(name)))

    def _looker(self, name: str) -> Any:
        def look(layer: nn.Module, inputs: Any, output: Any) -> None:
            if not _finite(output) and _finite(inputs):
                self.first_layers.append(f"{name} ({type(layer).__name__}, group {group_of(name + '.x')})")

        return look


class _AllNorms(Watch):
    """Also takes the norms of steps that no row ends with."""

    def __init__(self, module: StageModule, *, keep: int, scaled: bool) -> None:
        super().__init__(module, keep=keep, scaled=scaled)
        self.all_norms: dict[str, Tensor] = {}
        self._at = -1

    def gradients(self, params: Any, norm: Tensor | None) -> None:
        """Those of the latest step, of all its players."""
        found = self.groups.gradient_norms(params)
        self.all_norms = {**(self.all_norms if self._at == self.module.global_step else {}), **found}
        self._at = self.module.global_step
        super().gradients(params, norm)


def _finite(value: Any) -> bool:
    if isinstance(value, Tensor):
        return not value.is_floating_point() or bool(torch.isfinite(value).all())
    if isinstance(value, dict):
        return all(map(_finite, value.values()))
    if isinstance(value, list | tuple):
        return all(map(_finite, value))
    return True
