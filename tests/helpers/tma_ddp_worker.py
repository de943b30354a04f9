"""One rank of the distributed TMA and GPT tests: `python tma_ddp_worker.py RANK WORLD FOLDER`."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from safetensors.torch import load_file, save_file
from torch.nn.parallel import DistributedDataParallel

from motionloom.datasets.conditions import Condition
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.gpt.losses import GptLossConfig
from motionloom.models.gpt.module import GptModule
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.tma.losses import TmaLossConfig
from motionloom.models.tma.module import TmaModule
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.models.tokenizer.build import build_tokenizer
from motionloom.models.tokenizer.config import H2VQConfig
from motionloom.models.training.stage_module import OptimConfig, StageModule


class Wrapped(torch.nn.Module):
    """What Lightning does: DDP calls the losses through `forward`."""

    def __init__(self, module: StageModule) -> None:
        super().__init__()
        self.module = module

    def forward(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        return self.module.losses(batch)["loss"]


def batch_of(stored: dict[str, torch.Tensor]) -> dict[str, Any]:
    """A batch as it is stored, with its text as a condition."""
    batch: dict[str, Any] = dict(stored)
    if "text_tokens" in batch:
        batch["conditions"] = {"text": Condition(batch.pop("text_tokens"), batch.pop("text_mask"))}
    return batch


def build_tma() -> TmaModule:
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


def build_gpt() -> GptModule:
    torch.manual_seed(0)
    tokenizer = build_tokenizer(
        H2VQConfig(width=16, depth=1, code_dim=8, num_codes=9), MotionLayout.named("wholebody313")
    )
    for book in tokenizer.codebooks().values():
        book.codebook.normal_()
    tma = Tma(TmaConfig(latent=16, ff=32, layers=1, heads=2), 313, 10)
    config = GptConfig(layers=2, dim=32, heads=4, ff=64, block_size=30)
    net = InterleavedGPT(config, tokenizer.streams, tokenizer.pattern, text_dim=16)
    loss = GptLossConfig(align_weight=1.0)
    module = GptModule(net, OptimConfig(), seed=0, max_steps=1, loss=loss, tokenizer=tokenizer, tma=tma)
    return module.eval()


BUILDERS = {"tma": build_tma, "gpt": build_gpt}


def main() -> None:
    rank, world, folder = int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/init", rank=rank, world_size=world)
    for name, build in BUILDERS.items():
        batch = load_file(folder / f"{name}.safetensors")
        size = len(batch["length"]) // world
        local = batch_of({key: value[rank * size : (rank + 1) * size] for key, value in batch.items()})
        # In evaluation mode no text is dropped, so the GPT's null text goes unused.
        model = DistributedDataParallel(Wrapped(build()), find_unused_parameters=name == "gpt")
        loss = model(local)
        loss.backward()
        mean = loss.detach().clone()
        dist.all_reduce(mean)
        if rank == 0:
            parameters = model.module.module.net.named_parameters()
            grads = {key: p.grad for key, p in parameters if p.grad is not None}
            save_file({"loss": mean / world, **grads}, folder / f"{name}_result.safetensors")
    dist.barrier()
    # Leave without destructors: torch 2.13's DDP reducer can own the last reference to the gloo group, whose
    # destructor joins a thread that waits for the interpreter lock the reducer's destructor holds.
    os._exit(0)


if __name__ == "__main__":
    main()
