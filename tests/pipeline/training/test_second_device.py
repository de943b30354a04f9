"""Every stage of the baselines on a GPU, as far as a machine without one can show it (`second_device.py`).

Each stage runs whole: preparation, steps, validation, and what is drawn and judged afterwards. No step may
contain an operation whose result a GPU does not repeat, or wait for the device.
"""

from __future__ import annotations

import traceback
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.fabric import Fabric
from lightning.fabric.accelerators import CPUAccelerator
from lightning.fabric.strategies.single_device import SingleDeviceStrategy
from rich.console import Console
from second_device import SECOND, Far, second_device

from motionloom.models.training.stage_module import Batch
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.training import trainer
from motionloom.pipeline.training.config import TrainedStageConfig
from motionloom.pipeline.training.execution import Execution, repeatable

STARTS = {
    "utt": ["utt.loss.adversarial_start=1"],
    "dance_vq": ["dance_vq.root_start=1"],
    "actor_critic": ["actor_critic.reward.actor_steps=1", "actor_critic.reward.critic_steps=1"],
    "evaluator": ["evaluator.movement_steps=1"],
}
"""What begins later than the first steps, by the name of kind and stage."""

ANY_ORDER = {
    "index_add", "scatter_reduce", "put", "bincount", "histc", "kthvalue", "median", "nll_loss2d_forward",
    "_embedding_bag", "grid_sampler_2d_backward", "grid_sampler_3d_backward", "_ctc_loss",
    "reflection_pad1d_backward", "reflection_pad2d_backward", "replication_pad1d_backward",
    "replication_pad2d_backward", "upsample_linear1d_backward", "upsample_bilinear2d_backward",
    "max_pool3d_with_indices_backward", "adaptive_max_pool2d_backward", "_adaptive_avg_pool2d_backward",
    "avg_pool3d_backward", "fractional_max_pool2d_backward", "max_unpool2d", "logcumsumexp",
}  # fmt: skip
"""Operations that `torch.use_deterministic_algorithms` refuses on a GPU or turns into slow ones; sums of
gradients that a gather or an index gives (scatter_add, index_put) it sorts."""

WAITS = {"_local_scalar_dense", "item", "nonzero", "masked_select", "is_nonzero", "_unique2"}
"""Operations that read from the device."""

MAY_WAIT = {"ActorCriticModule"}
"""Its rewards are beats of dances, which numpy finds."""


OTHERS = """
name: others
seed: 7
stages:
  data: {kind: synth}
  stats: {kind: stats}
  text: {kind: text}
  tm2t: {kind: tm2t, net: {width: 16, code_dim: 8, num_codes: 12}, critic: {start: 1, width: 8}}
  inbetween: {kind: inbetween, max_frames: 80, net: {dim: 32, ff: 32, layers: 1, heads: 2}}
"""
"""Kinds that those recipes lack; that of beats needs an instrument's sounds."""


class Anywhere(CPUAccelerator):
    """Sets up any device."""

    def setup_device(self, device: torch.device) -> None:
        """Nothing to do."""


class Watch:
    """Notes what is found in steps, by module, with the line of ours that it came from."""

    def __init__(self) -> None:
        self.module = ""
        self.found: dict[str, set[str]] = defaultdict(set)

    def __call__(self, name: str, args: Sequence[Any], out: Any) -> None:
        """See one operation."""
        if not self.module:
            return
        short = name.removeprefix("aten::").rstrip("_")
        value = args[0] if args and isinstance(args[0], torch.Tensor) else None
        far = isinstance(value, Far)
        summed = short in ("cumsum", "cumprod") and value is not None and value.is_floating_point()
        read = short in WAITS or (far and short in ("_to_copy", "to") and not isinstance(out, Far))
        if far and (short in ANY_ORDER or summed or (read and self.module not in MAY_WAIT)):
            files = ((frame.filename, frame.lineno) for frame in traceback.extract_stack())
            ours = [place for place in files if "/models/" in place[0] or "/pipeline/" in place[0]]
            self.found[self.module].add(f"{name} at {ours[-1]}")

    def take_step(self, execution: Execution, parts: Iterable[Batch]) -> torch.Tensor:
        """Watch one training step, once its batch is there."""
        read = list(parts)
        self.module = type(execution.module).__name__
        try:
            return taken(execution, read)
        finally:
            self.module = ""


taken = Execution.take_step


def on_second(*_: object) -> Fabric:
    """One process on `SECOND`."""
    return Fabric(strategy=SingleDeviceStrategy(SECOND, Anywhere()), devices=1)


def few_steps(recipe: str) -> list[str]:
    """Two steps of every training, on few clips; nothing waits for its first step."""
    sets = ["data.clips=40", "hardware.accelerator=cpu", "hardware.threads=1", "hardware.convert_workers=1"]
    sets.append("hardware.loggers=[]")
    for stage in load_recipe(recipe).stages:
        if isinstance(stage.config, TrainedStageConfig):
            one = f"{stage.name}.train"
            sets += [f"{one}.{key}=2" for key in ("steps", "checkpoint_every", "validate_every")]
            sets += [f"{one}.batch_size=8", *STARTS.get(stage.name, ())]
    return sets


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("recipe", ["baselines-tiny", "baselines-tiny-ude", "others.yaml"])
def test_every_stage_runs_on_a_second_device(
    recipe: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = Watch()
    monkeypatch.chdir(tmp_path)
    Path("others.yaml").write_text(OTHERS)
    monkeypatch.setattr(trainer, "launch", on_second)
    monkeypatch.setattr(Hardware, "device", lambda self: SECOND)
    monkeypatch.setattr(Execution, "take_step", lambda self, parts: watch.take_step(self, parts))
    with second_device(watch):
        run_recipe(recipe, tmp_path / "run", overrides=few_steps(recipe), console=Console(quiet=True))
    assert watch.found == {}


def test_the_watch_sees_any_order_and_reading() -> None:
    watch = Watch()
    with second_device(watch) as device:
        far, at = torch.ones(3).to(device), torch.tensor([0, 0, 2]).to(device)
        watch.module = "x"
        far.cumsum(0), at.cumsum(0), far.index_add(0, at, far), far.cpu()
        far.sum().item()
    assert {found.split()[0] for found in watch.found["x"]} == {
        "aten::cumsum",
        "aten::index_add",
        "aten::_to_copy",
        "aten::_local_scalar_dense",
    }


def test_a_gpu_repeats_itself_unless_told_otherwise() -> None:
    on = torch.are_deterministic_algorithms_enabled
    for hardware, wanted in ((Hardware(accelerator="gpu"), True), (Hardware(accelerator="cpu"), False)):
        with repeatable(hardware):
            assert on() == wanted
        assert not on()
    with repeatable(Hardware(accelerator="gpu", deterministic=False)):
        assert not on()
