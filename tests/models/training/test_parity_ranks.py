"""Training on two ranks equals training in one process, for every kind of stage, over 12 optimizer steps.

Two gloo processes with half of each batch each, under DDP as the pipeline sets it up, against one process
with the whole batch: the loss of every step, the last gradients and the weights and codebooks agree to 1e-5.
Ranks hold different numbers of real frames and tokens, and in one case no hands. Losses with collectives are
also compiled, as one graph.

The networks that learn are float64. In float32 the order of a sum changes the last bit, and AdamW divides a
gradient by its own size: where the true gradient is zero (the bias of attention keys, which a softmax
cancels) it turns that bit into a step of the learning rate. Codebooks, losses and code assignment stay
float32, as in training.
Nothing is drawn: there is no dropout, and the networks that sample latents or codes run in evaluation mode,
or draw by seeds that do not depend on the rank.

The processes run this file as a script.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from rank_cases import BATCH, CASES, STEPS, rows_of
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from two_ranks import pair_of, work

from motionloom.models.training.distributed import rank, world_size
from motionloom.models.training.stage_module import StageModule

pytestmark = pytest.mark.slow


class Wrapped(nn.Module):
    """What Lightning does: DDP calls the losses through `forward`."""

    def __init__(self, module: StageModule) -> None:
        super().__init__()
        self.module = module

    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        return self.module.losses(batch)


def train(case: str) -> dict[str, Any]:
    """12 steps on this rank's part of the batches; figures are averaged over ranks."""
    torch.manual_seed(0)
    module, batches = CASES[case]()
    module.net.double()
    optimizer = module.configure_optimizers()[0]["optimizer"]
    if case.endswith("compiled"):
        torch.compiler.reset()  # graphs of other tests in this process count too
        module.losses = torch.compile(module.losses, fullgraph=True, backend="eager")  # type: ignore[method-assign]
    model: nn.Module = Wrapped(module)
    if world_size() > 1:
        # The null text stays unused in evaluation mode.
        model = DistributedDataParallel(
            model, forward_sync_buffers=False, find_unused_parameters=case.startswith("gpt")
        )
    size = BATCH // world_size()
    mine = slice(rank() * size, (rank() + 1) * size)
    figures: dict[str, list[float]] = {}
    for step in range(STEPS):
        values = model(rows_of(batches(step), mine))
        optimizer.zero_grad()
        values["loss"].backward()
        for name, value in values.items():
            mean = value.detach().double()
            if world_size() > 1:
                dist.all_reduce(mean)
            figures.setdefault(name, []).append(mean.item() / world_size())
        if step < STEPS - 1:
            optimizer.step()
    grads = {name: p.grad for name, p in module.net.named_parameters() if p.grad is not None}
    return {"figures": figures, "grads": grads, "state": module.net.state_dict()}


def worker(folder: Path) -> None:
    dist.init_process_group("gloo")
    torch.save({case: train(case) for case in CASES}, folder / f"{rank()}.pt")


pair = pair_of(__file__)


@pytest.fixture(scope="module")
def two(pair: Path) -> list[dict[str, Any]]:
    """What each of two ranks found, per case."""
    return [torch.load(pair / f"{number}.pt", weights_only=True) for number in range(2)]


@pytest.mark.timeout(240)
@pytest.mark.parametrize("case", list(CASES))
def test_two_ranks_equal_one_process(case: str, two: list[dict[str, Any]]) -> None:
    one = train(case)
    for name, values in one["figures"].items():
        assert two[0][case]["figures"][name] == pytest.approx(values, rel=1e-5, abs=1e-5), name
    for kind in ("grads", "state"):
        assert one[kind].keys() == two[0][case][kind].keys()
        for name, value in one[kind].items():
            first, second = (result[case][kind][name] for result in two)
            assert torch.equal(first, second), name
            torch.testing.assert_close(first, value, rtol=1e-5, atol=1e-5, msg=lambda m, n=name: f"{n}: {m}")
    resets = [sum(v[1:]) for name, v in one["figures"].items() if name.startswith("resets")]
    if case.startswith(("h2vq", "rvq", "separate")):
        assert sum(resets) > 5, "the codebooks were too calm to prove much"


if __name__ == "__main__":
    work(worker)
