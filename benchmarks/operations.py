"""Operations of a training step at the papers' sizes: how many, and how much of them is copying.

    python benchmarks/operations.py
    python benchmarks/operations.py --token --record operations_token

A step (both passes, clipping, optimizer) in bf16, batch and loss as the recipe has them, on fake tensors:
seconds on any machine. Views count nothing, attention as a GPU's fused kernel. What a library does inside an
operation, such as cudnn's changes of layout, is not seen.

With `--token`, what a GPU starts for a token of the GPT of 18 layers: of the plain step all operations but
views; of the fused one these outside of compiled code, and inside of it the kernels that are left when
inductor has fused what it can. It compiles for this CPU; for a GPU it fuses about as much. Then what is
computed for requests of the paper's lengths: places of the cache that are attended to, and rows of the batch.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any, cast
from unittest import mock

import torch
from bench import Column, Record, arguments, command_line, report
from lightning.fabric import Fabric
from torch import Tensor
from torch._inductor import config as inductor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves

from motionloom.models.gpt import decoding
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.gpt.rows import Drawing, Rows
from motionloom.models.layers.attention import SelfAttention
from motionloom.models.tokenizer.base import Stream
from motionloom.pipeline.contract.lookup import previews
from motionloom.pipeline.inference.generation import batches_by_length
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


TOKEN = (
    Column("plain, float32", "float32"),
    Column("plain, bfloat16", "bfloat16"),
    Column("blocks fused", "fused"),
    Column("few rows as sums", "sums"),
)
WORK = (Column("of a batch of fixed shape", "fixed"), Column("now", "now"), Column("graphs", "graphs"))
GROUPS = 49
"""Most groups of a request, of four frames each."""


def gpt_rows(layers: int, rows: int, limit: Tensor) -> tuple[InterleavedGPT, Rows]:
    """A GPT of the paper's depth or less, and rows of it; widths do not matter for a count."""
    streams = (Stream("body", 512, 2), Stream("hand", 512, 1))
    config = GptConfig(layers=layers, dim=64, heads=4, ff=128)
    gpt = InterleavedGPT(config, streams, ("body", "body", "hand"), text_dim=8).eval()
    most = -(-int(limit.max()) * 3 // decoding.ROOM) * decoding.ROOM
    uniform = torch.rand(rows, most, dtype=torch.float64)
    start = torch.zeros(rows, most, dtype=torch.int64)
    first = gpt.embed_text(torch.randn(rows, 8))
    how = Drawing()
    drawn = Rows(gpt, start, limit * 0, limit, first=first, uniform=uniform, free=False, how=how, scale=None)
    return gpt, drawn


def token(rows: int) -> Record:
    """Return what one token of so many motions starts."""
    counts = Counted()
    fused: Counter[str] = Counter()
    kernels: dict[object, int] = {}

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            key = function, *(x.dtype for x in args if isinstance(x, Tensor))
            found: list[int] = []
            with (
                _disable_current_modes(),
                inductor.patch(force_disable_caches=True, _post_fusion_custom_pass=partial(_groups, found)),
            ):
                out = torch.compile(function, fullgraph=True)(*args)
            kernels.setdefault(key, sum(found))
            fused[function.__name__] += kernels[key]
            return out

        return call

    cells = {}
    ways = {"float32": 0, "bfloat16": 0, "fused": 0, "sums": decoding.FEW}
    for name, few in ways.items():
        fused.clear()
        kernels.clear()
        torch.compiler.reset()
        with (
            torch.no_grad(),
            torch.autocast("cpu", torch.bfloat16, enabled=name != "float32"),
            mock.patch.object(decoding, "FEW", few),
            mock.patch.object(decoding, "_compiled", compiled),
        ):
            steps = decoding.FixedSteps(None, *gpt_rows(18, rows, torch.full((rows,), 2)))
            counts.number.clear()
            with counts:
                step = decoding.advance_fused if name in ("fused", "sums") else decoding.advance
                step(steps.gpt, steps.rows, steps.cache)
        cells[name] = f"{counts.number.total() + fused.total()}"
    return {"title": f"{rows} at once", "cells": cells}


def places() -> list[Record]:
    """Places attended to, a token, of one graph of fixed shape and of one each `ROOM` places."""
    out = []
    for groups in (17, GROUPS):
        tokens = 3 * groups
        fixed = -(-tokens // decoding.ROOM) * decoding.ROOM
        seen = [(number // decoding.ROOM + 1) * decoding.ROOM for number in range(tokens)]
        cells = {"fixed": f"{fixed}", "now": f"{sum(seen) / tokens:.0f}", "graphs": f"{len(set(seen))}"}
        out.append({"title": f"places attended to, a token of {tokens}", "cells": cells})
    return out


def left() -> list[Record]:
    """Rows computed, a token of 1,024 requests of 4 to 49 groups: 256 at once as they come, all in one batch
    each to its end; then without rows that have ended, then sorted by length, too."""
    groups = torch.randint(4, GROUPS + 1, (1024,), generator=torch.Generator().manual_seed(0))
    wanted = int(groups.sum()) * 3
    frames = (4 * groups).tolist()
    came = [list(range(i, i + 256)) for i in range(0, 1024, 256)]
    fixed = sum(3 * int(groups[rows].max()) * len(rows) for rows in came)
    out = []
    for title, batches in {"as they come": came, "sorted": batches_by_length(frames, 256)}.items():
        shapes = Counter[tuple[int, int]]()
        for batch in batches:
            _, rows = gpt_rows(1, len(batch), groups[batch])

            def step(number: int, rows: Rows = rows, shapes: Counter[tuple[int, int]] = shapes) -> None:
                shapes[len(rows.tokens), number // decoding.ROOM] += 1
                rows.at += 1

            rows.run(step, lambda _: None)
        computed = sum(size * steps for (size, _), steps in shapes.items())
        cells = {
            "fixed": f"{fixed / wanted:.2f}",
            "now": f"{computed / wanted:.2f}",
            "graphs": f"{len(shapes)}",
        }
        out.append({"title": f"rows computed for one that is drawn, {title}", "cells": cells})
    return out


def _groups(found: list[int], nodes: list[Any]) -> list[Any]:
    """Add the number of kernels to `found`: results taken apart and places reserved are none."""
    names = [type(getattr(node, "node", None)).__name__ for node in nodes]
    found.append(sum(name not in ("MultiOutput", "ConcatKernel") for name in names))
    return nodes


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--token", action="store_true", help="count a sampled token instead")
    args = arguments(parser)
    record = args.record
    if args.token:
        report("What a sampled token starts, 18 layers", TOKEN, [token(1), token(256)], record)
        work = f"{record}_work" if record else None
        report("What is computed for a sampled token", WORK, [*places(), *left()], work)
        return
    report("Operations of a training step", COLUMNS, [row(title) for title in STAGES], record)


if __name__ == "__main__":
    main()
