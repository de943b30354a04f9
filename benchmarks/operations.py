"""Operations of a training step at the papers' sizes: how many, and how much of them is copying.

    python benchmarks/operations.py [--only gpt tma] [--record operations]

A step (forward and backward pass, clipping, optimizer) of a stage of a recipe, in bf16, batch and loss as the
recipe has them, on fake tensors, which have shapes and no values: seconds on any machine, and no GPU. Counted
are operations that compute or copy, as they come to the device's kernels; views count nothing. Attention is
counted as the fused kernel that a GPU has. What a library does inside an operation, such as cudnn's changes
of layout, is not seen.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import torch
from bench import Column, Record, arguments, command_line, report
from lightning.fabric import Fabric
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.optim import Optimizer
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from motionloom.models.layers.transformer import SelfAttention
from motionloom.models.training.stage_module import Batch, StageModule
from motionloom.pipeline.contract.lookup import previews
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.training.execution import launch, prepare_module

STAGES = {
    "tokenizer (H2VQ)": ("humantomato-paper", "tokenizer"),
    "TMA": ("humantomato-paper", "tma"),
    "GPT with L_align": ("humantomato-paper", "gpt"),
    "UTT with its critic": ("ude-paper", "utt"),
    "DMD": ("ude-paper", "dmd"),
    "MDM": ("baselines-paper", "mdm"),
}
KINDS = {
    "casts": ("_to_copy",),
    "copies": ("copy_", "clone", "_foreach_copy_", "masked_fill"),
    "concatenations": ("cat", "stack"),
    "sent": ("lift_fresh",),
    "read back": ("_local_scalar_dense", "nonzero", "is_nonzero", "equal", "masked_select"),
}
"""Operations that move numbers without computing any (`masked_fill` copies, then fills), and those that a GPU
must be waited for: constants sent there, and numbers read back."""
_VIEWS = ("_unsafe_view", "_reshape_alias", "detach")
"""Views that do not say so."""
COLUMNS = (
    Column("batch", "batch"),
    Column("operations", "operations"),
    *(Column(kind, kind) for kind in KINDS),
    Column("GB of casts, copies and concatenations", "moved"),
)


class Counted(TorchDispatchMode):
    """Counts operations that are no views, and the bytes that the moving ones read and write."""

    def __init__(self) -> None:
        super().__init__()
        self.number: Counter[str] = Counter()
        self.bytes: Counter[str] = Counter()
        self.shapes: Counter[str] = Counter()
        """Bytes by operation, shape and type."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        tensors = [x for x in tree_leaves((args, kwargs, out)) if isinstance(x, Tensor)]
        if func.namespace == "aten" and name not in _VIEWS and (name == "lift_fresh" or not func.is_view):
            self.number[name] += 1
            size = sum(x.numel() * x.element_size() for x in tensors)
            self.bytes[name] += size
            first = tensors[0] if tensors else torch.empty(0)
            self.shapes[f"{name} {list(first.shape)} {first.dtype}"] += size
        return out


def counted(recipe: str, stage_name: str) -> tuple[Counted, int]:
    """The counts of a stage's second step, and its batch."""
    loaded = load_recipe(recipe)
    stage, kind = loaded.stage(stage_name), loaded.stage(stage_name).kind
    config, stages = stage.config, {one.name: one for one in loaded.stages}
    if stage_name == "gpt":
        config = config.model_copy(update={"loss": config.loss.model_copy(update={"align_from": 0})})
    hardware, size = Hardware(accelerator="cpu"), config.train.local_batch(1)
    fabric = launch(hardware, config.train)
    with FakeTensorMode(allow_non_fake_inputs=True):
        dry: Any = kind
        inputs = dry.inputs.of(previews(stage, stages))
        net = dry.network(dry.facts(config, inputs), inputs)
        module, batch = dry.dry_module(config, net, inputs), dry.example(config, net, inputs, size).batch
        for layer in module.modules():  # a CPU has no fused kernel with dropout
            if isinstance(layer, SelfAttention):
                layer.attention_dropout = 0.0
        prepare_module(module.train(), config.train)
        module.fabric = fabric  # with which modules of several optimizers go backwards
        optimizers = [one["optimizer"] for one in module.configure_optimizers()]
        for counts in (Counted(), Counted()):  # the first step makes codebooks and moments
            with counts:
                _step(fabric, module, optimizers, batch)
            module.step += 1
    return counts, size


def _step(fabric: Fabric, module: StageModule, optimizers: list[Optimizer], batch: Batch) -> None:
    """What `Execution.take_step` does, which moves modules between devices first."""
    with fabric.autocast():
        loss = module.training_step(batch, 0)
    if module.automatic_optimization:
        optimizers[0].zero_grad()
        fabric.backward(loss)
        module.configure_gradient_clipping(optimizers[0])
        optimizers[0].step()


def rows(names: list[str], largest: int) -> Iterator[Record]:
    for name in names:
        counts, batch = counted(*STAGES[name])
        moved = sum(counts.bytes[op] for kind in ("casts", "copies", "concatenations") for op in KINDS[kind])
        cells = {"batch": str(batch), "operations": f"{counts.number.total():,}"}
        cells["moved"] = f"{moved / 1e9:.2f}"
        cells |= {kind: str(sum(counts.number[op] for op in ops)) for kind, ops in KINDS.items()}
        yield {"title": name, "cells": cells}
        for text, size in counts.shapes.most_common(largest):
            print(f"{name}: {size / 1e9:.2f} GB {text}")


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--only", nargs="+", choices=[pair[1] for pair in STAGES.values()])
    parser.add_argument("--largest", type=int, default=0, help="print so many operations by their bytes")
    args = arguments(parser)
    names = [name for name, pair in STAGES.items() if args.only is None or pair[1] in args.only]
    report("Operations of a training step", COLUMNS, list(rows(names, args.largest)), args.record)


if __name__ == "__main__":
    main()
