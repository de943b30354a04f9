"""Codebooks under two gloo processes: the same on both, and those of one process on the whole batch.

The processes run this file as a script: spawned workers could not import a test module by name.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
import torch.distributed as dist

from motionloom.models.quantize.ema import QuantizerConfig
from motionloom.models.quantize.residual import ResidualQuantizer

STEPS = 6
CONFIG = QuantizerConfig(num_codes=24, dim=8)


def batch(step: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The global batch [4, 15, 8] and its mask; per rank only 30 rows (some masked) for 24 codes."""
    generator = torch.Generator().manual_seed(step)
    z = torch.randn(4, 15, 8, generator=generator) + step  # drifting, so that codes die
    return z, torch.arange(15) < torch.tensor([15, 9, 15, 3])[:, None]


def train(start: int, stop: int) -> tuple[dict[str, torch.Tensor], list[float]]:
    torch.manual_seed(start)  # ranks start apart; the first batch must bring them together
    quantizer = ResidualQuantizer(CONFIG, 2)
    resets = []
    for step in range(STEPS):
        z, mask = batch(step)
        out = quantizer(z[start:stop], mask[start:stop])
        resets.append(out.metrics["resets"].sum().item())
    return quantizer.state_dict(), resets


def worker(rank: int, out: Path) -> None:
    dist.init_process_group("gloo", init_method=f"file://{out}/rendezvous", rank=rank, world_size=2)
    try:
        state, resets = train(2 * rank, 2 * rank + 2)
        torch.save({"state": state, "resets": resets}, out / f"{rank}.pt")
    finally:
        dist.destroy_process_group()


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_two_ranks_equal_one_process(tmp_path: Path) -> None:
    command = [sys.executable, "-P", __file__]
    processes = [subprocess.Popen([*command, str(r), str(tmp_path)]) for r in range(2)]
    assert [p.wait(100) for p in processes] == [0, 0]
    ranks = [torch.load(tmp_path / f"{r}.pt", weights_only=True) for r in range(2)]
    alone, resets = train(0, 4)
    assert sum(resets[1:]) > 10
    assert ranks[0]["resets"] == ranks[1]["resets"] == resets
    for name, value in alone.items():
        assert torch.equal(ranks[0]["state"][name], ranks[1]["state"][name]), name
        torch.testing.assert_close(ranks[0]["state"][name], value, rtol=1e-5, atol=1e-5)


if __name__ == "__main__":
    worker(int(sys.argv[1]), Path(sys.argv[2]))
