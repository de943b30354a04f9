"""Operations of a training step at the papers' sizes: how many, and how much of them is copying.

    python benchmarks/operations.py

A step (both passes, clipping, optimizer) in bf16, batch and loss as the recipe has them, on fake tensors:
seconds on any machine. Views count nothing, attention as a GPU's fused kernel. What a library does inside an
operation, such as cudnn's changes of layout, is not seen.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, cast

from bench import Column, Record, arguments, command_line, report
from lightning.fabric import Fabric
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from motionloom.models.layers.attention import SelfAttention
from motionloom.pipeline.contract.lookup import previews
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.training.execution import prepare_module

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
    "copies": ("copy_", "clone", "masked_fill"),
    "concatenations": ("cat", "stack"),
    "waits": ("lift_fresh", "_local_scalar_dense", "nonzero", "masked_select"),
}
"""Operations that move numbers without computing any (`masked_fill` copies, then fills); and those that a GPU
must be waited for, constants sent there and numbers read back."""
COLUMNS = tuple(Column(name, name) for name in ("batch", "operations", *KINDS, "GB moved"))


class Counted(TorchDispatchMode):
    """Counts operations that are no views, and the bytes that they read and write."""

    def __init__(self) -> None:
        super().__init__()
        self.number: Counter[str] = Counter()
        self.bytes: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        view = (func.is_view and name != "lift_fresh") or name in ("_unsafe_view", "detach")
        if func.namespace == "aten" and not view:
            tensors = [x for x in tree_leaves((args, kwargs, out)) if isinstance(x, Tensor)]
            self.number[name] += 1
            self.bytes[name] += sum(x.numel() * x.element_size() for x in tensors)
        return out


def counted(recipe: str, name: str) -> tuple[Counted, int]:
    """The counts of a stage's second step, and its batch."""
    loaded = load_recipe(recipe)
    stage = loaded.stage(name)
    stages = {one.name: one for one in loaded.stages}
    config = stage.config
    dry = cast(Any, stage.kind)
    if name == "gpt":
        config = config.model_copy(update={"loss": config.loss.model_copy(update={"align_from": 0})})
    fabric = Fabric(accelerator="cpu", precision=config.train.precision)
    size = config.train.local_batch(1)
    with FakeTensorMode(allow_non_fake_inputs=True):
        inputs = dry.inputs.of(previews(stage, stages))
        net = dry.network(dry.facts(config, inputs), inputs)
        module = dry.dry_module(config, net, inputs)
        batch = dry.example(config, net, inputs, size).batch
        for layer in module.modules():  # a CPU has no fused kernel with dropout
            if isinstance(layer, SelfAttention):
                layer.attention_dropout = 0.0
        prepare_module(module.train(), config.train)
        module.fabric = fabric  # with which modules of several optimizers go backwards
        optimizer = module.configure_optimizers()[0]["optimizer"]
        for counts in (Counted(), Counted()):  # the first step makes codebooks and moments
            with counts:  # what a Trainer does, which moves modules between devices first
                with fabric.autocast():
                    loss = module.training_step(batch, 0)
                if module.automatic_optimization:
                    optimizer.zero_grad()
                    fabric.backward(loss)
                    module.configure_gradient_clipping(optimizer)
                    optimizer.step()
            module.step += 1
    return counts, size


def row(title: str) -> Record:
    counts, batch = counted(*STAGES[title])
    each = {kind: str(sum(counts.number[op] for op in ops)) for kind, ops in KINDS.items()}
    moved = sum(counts.bytes[op] for kind, ops in KINDS.items() if kind != "waits" for op in ops)
    whole = {"batch": str(batch), "operations": str(counts.number.total()), "GB moved": f"{moved / 1e9:.2f}"}
    return {"title": title, "cells": whole | each}


def main() -> None:
    record = arguments(command_line(__doc__)).record
    report("Operations of a training step", COLUMNS, [row(title) for title in STAGES], record)


if __name__ == "__main__":
    main()
