"""One rank of the distributed TMA test: `python tma_ddp_worker.py RANK WORLD FOLDER`."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import torch
import torch.distributed as dist
from safetensors.torch import load_file, save_file
from torch.nn.parallel import DistributedDataParallel

from motionloom.models.stage_module import OptimConfig
from motionloom.models.tma.module import TmaLossConfig, TmaModule
from motionloom.models.tma.network import Tma, TmaConfig


class Wrapped(torch.nn.Module):
    """What Lightning does: DDP calls the losses through `forward`."""

    def __init__(self, module: TmaModule) -> None:
        super().__init__()
        self.module = module

    def forward(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        return self.module.losses(batch)["loss"]


def build() -> TmaModule:
    torch.manual_seed(0)
    config = TmaConfig(latent=16, ff=32, layers=2, heads=2)
    module = TmaModule(
        Tma(config, 7, 5),
        OptimConfig(),
        seed=0,
        max_steps=1,
        # Heavier weights than the paper's, so that an error in any term would show.
        loss=TmaLossConfig(kl=0.1, latent=0.1, contrastive=1.0),
    )
    return module.eval()  # no dropout, no latent noise: the two runs draw nothing


def main() -> None:
    rank, world, folder = int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/init", rank=rank, world_size=world)
    batch = load_file(folder / "batch.safetensors")
    size = len(batch["length"]) // world
    local = {key: value[rank * size : (rank + 1) * size] for key, value in batch.items()}
    model = DistributedDataParallel(Wrapped(build()))
    loss = model(local)
    loss.backward()
    mean = loss.detach().clone()
    dist.all_reduce(mean)
    if rank == 0:
        grads = {name: p.grad for name, p in model.module.module.net.named_parameters() if p.grad is not None}
        save_file({"loss": mean / world, **grads}, folder / "result.safetensors")
    dist.barrier()
    # Leave without destructors: torch 2.13's DDP reducer can own the last reference to the gloo group, whose
    # destructor joins a thread that waits for the interpreter lock the reducer's destructor holds.
    os._exit(0)


if __name__ == "__main__":
    main()
