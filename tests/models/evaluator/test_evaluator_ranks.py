"""The evaluator's losses on two ranks equal those of one process, values and gradients alike.

Two gloo processes with half of the batch each, of different numbers of real frames and words, against one
with the whole batch. Networks are float64, losses float32 as in training; nothing is drawn.

The processes run this file as a script.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from batch_rows import rows_of
from two_ranks import run_two_ranks

from motionloom.datasets.conditions import Condition
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.evaluator.module import EvaluatorModule
from motionloom.models.evaluator.network import Evaluator, EvaluatorConfig
from motionloom.models.training.distributed import mean_gradients, rank, world_size
from motionloom.models.training.optim import OptimConfig

pytestmark = pytest.mark.slow

BATCH = 6
LAYOUT = MotionLayout.named("body133")
CONFIG = EvaluatorConfig(movement_hidden=8, movement=8, motion_hidden=8, text_hidden=8, latent=4, dropout=0)


def whole_batch() -> dict[str, Any]:
    generator = torch.Generator().manual_seed(0)
    motion = torch.randn(BATCH, 24, LAYOUT.dim, generator=generator, dtype=torch.float64)
    words = torch.randn(BATCH, 4, 3, generator=generator, dtype=torch.float64)
    mask = torch.arange(4)[None] < torch.tensor([4, 2, 3, 1, 4, 2])[:, None]
    length = torch.tensor([24, 23, 9, 5, 24, 4])
    return {"motion": motion, "length": length, "conditions": {"text": Condition(words, mask, None)}}


def losses() -> dict[str, dict[str, Any]]:
    """Figures, averaged over ranks, and gradients of each player."""
    torch.manual_seed(0)
    net = Evaluator(CONFIG, LAYOUT, 3, 24)
    optim = OptimConfig()
    module = EvaluatorModule(net, optim, seed=0, max_steps=2, movement_optim=optim, movement_steps=1).double()
    size = BATCH // world_size()
    batch = rows_of(whole_batch(), slice(rank() * size, (rank() + 1) * size))
    out: dict[str, dict[str, Any]] = {}
    for player in module.players():
        module.zero_grad()
        values = module.play(player.name, batch, {})
        values["loss"].backward()
        mean_gradients(player.params())
        for name, value in values.items():
            figure = value.detach().double().clone()
            if world_size() > 1:
                dist.all_reduce(figure)
            out.setdefault("figures", {})[f"{player.name}_{name}"] = figure / world_size()
        grads = {name: p.grad.clone() for name, p in module.named_parameters() if p.grad is not None}
        out[player.name] = grads
    return out


def worker(number: int, folder: Path) -> None:
    torch.set_num_threads(1)
    init = f"file://{folder}/rendezvous"
    dist.init_process_group("gloo", init_method=init, rank=number, world_size=2)
    torch.save(losses(), folder / f"{number}.pt")
    dist.barrier()
    os._exit(0)


@pytest.mark.timeout(150)
def test_two_ranks_equal_one_process(tmp_path: Path) -> None:
    run_two_ranks(__file__, tmp_path, numbered=True, timeout=120)
    two = [torch.load(tmp_path / f"{number}.pt", weights_only=True) for number in range(2)]
    one = losses()
    assert len(one["movement"]) == 12 and len(one["matching"]) == 34
    for kind, values in one.items():
        for name, value in values.items():
            first, second = (found[kind][name] for found in two)
            torch.testing.assert_close(first, second, rtol=0, atol=0)
            torch.testing.assert_close(
                first, value, rtol=1e-5, atol=1e-6, msg=lambda m, n=f"{kind}: {name}": f"{n}: {m}"
            )


if __name__ == "__main__":
    worker(int(sys.argv[1]), Path(sys.argv[2]))
