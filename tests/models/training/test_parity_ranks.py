"""Training on two ranks equals training in one process, for every kind of stage, over 20 optimizer steps.

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

With draws by sample everything is drawn, and trainings go on from two ranks to one and to two again.

The processes run this file as a script.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from batch_rows import rows_of
from rank_cases import BATCH, CASES, ELASTIC, LENGTH, STEPS
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from two_ranks import run_two_ranks

from motionloom.datasets.conditions import Condition
from motionloom.models.layers import random
from motionloom.models.training.distributed import alone, rank, sum_over_ranks, world_size
from motionloom.models.training.stage_module import StageModule

pytestmark = pytest.mark.slow

PHASES = ((0, 4), (4, 8), (8, 12))
"""Steps on two ranks, on one, on two again."""


def trimmed(batch: dict[str, Any]) -> dict[str, Any]:
    """Without the padding that no row of this rank needs, as the loaders give it."""
    out = dict(batch)
    if "tokens" in batch:
        longest = int((batch["tokens"] >= 0).sum(1).max())
        out |= {name: batch[name][:, :longest] for name in ("tokens", "kinds", "known")}
    elif batch["motion"].shape[-1] == 20:
        out["motion"] = batch["motion"][:, : int(batch["length"].max())]
    if "conditions" in batch:
        text = batch["conditions"]["text"]
        size = int(text.mask.sum(1).max())
        out["conditions"] = {"text": Condition(text.features[:, :size], text.mask[:, :size], text.pooled)}
    return out


def elastic(case: str, steps: range, state: Path | None = None) -> list[dict[str, float]]:
    """Figures of some steps, drawn by sample, gone on from `state` and written there where given."""
    torch.manual_seed(0)
    module, batches = ELASTIC[case]()
    module.train().net.double()
    module.draw_by_sample = True
    optimizer = module.configure_optimizers()[0]
    if state is not None and state.is_file():
        saved = torch.load(state, weights_only=True)
        module.net.load_state_dict(saved["net"])
        optimizer.load_state_dict(saved["optimizer"])
    model: nn.Module = Wrapped(module)
    if world_size() > 1:
        model = DistributedDataParallel(model, forward_sync_buffers=False)
    size = BATCH // world_size()
    mine = slice(rank() * size, (rank() + 1) * size)
    rows = []
    for step in steps:
        module.step = step
        batch = {"length": LENGTH, **batches(step)}
        batch = trimmed(rows_of(batch, mine))
        torch.manual_seed(1000 * rank() + step)  # torch's own draws would differ
        module.key_draws(batch, 0)
        values = model(batch)
        optimizer.zero_grad()
        values["loss"].backward()
        random.end()
        optimizer.step()
        names, figures = list(values), torch.stack([v.detach().double() for v in values.values()])
        rows.append(dict(zip(names, (sum_over_ranks(figures) / world_size()).tolist(), strict=True)))
    if state is not None and rank() == 0:
        torch.save({"net": module.net.state_dict(), "optimizer": optimizer.state_dict()}, state)
    return rows


def elastic_phases(case: str, folder: Path) -> list[dict[str, float]]:
    """Two ranks, then the first alone, then two."""
    state, found = folder / f"{case}.state", []
    for number, (first, end) in enumerate(PHASES):
        if number != 1:
            found += elastic(case, range(first, end), state)
        elif rank() == 0:
            with alone():
                found += elastic(case, range(first, end), state)
        dist.barrier()
    return found


class Wrapped(nn.Module):
    """What Lightning does: DDP calls the losses through `forward`."""

    def __init__(self, module: StageModule) -> None:
        super().__init__()
        self.module = module

    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        return self.module.losses(batch)


def train(case: str) -> dict[str, Any]:
    """20 steps on this rank's part of the batches; figures are averaged over ranks."""
    torch.manual_seed(0)
    module, batches = CASES[case]()
    module.net.double()
    optimizer = module.configure_optimizers()[0]
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


def worker(number: int, folder: Path) -> None:
    torch.set_num_threads(1)
    init = f"file://{folder}/rendezvous"
    dist.init_process_group("gloo", init_method=init, rank=number, world_size=2)
    torch.save({case: train(case) for case in CASES}, folder / f"{number}.pt")
    rows = {case: elastic_phases(case, folder) for case in ELASTIC}
    (folder / f"{number}.json").write_text(json.dumps(rows))
    dist.barrier()
    # Without destructors: those of DDP and gloo can wait for each other.
    os._exit(0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the two ranks have written what they found."""
    folder = tmp_path_factory.mktemp("ranks")
    run_two_ranks(__file__, folder, numbered=True)
    return folder


@pytest.fixture(scope="module")
def two(folder: Path) -> list[dict[str, Any]]:
    """What each of two ranks found, per case."""
    return [torch.load(folder / f"{number}.pt", weights_only=True) for number in range(2)]


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


@pytest.mark.timeout(240)
@pytest.mark.parametrize("case", list(ELASTIC))
def test_from_two_ranks_to_one_and_back_equals_one_process(case: str, folder: Path) -> None:
    """Losses and all figures of every step, to 1e-6; the losses that are left in float32 are that exact."""
    one = elastic(case, range(PHASES[-1][1]))
    found = json.loads((folder / "0.json").read_text())[case]
    assert len(found) == len(one)
    for step, (row, expected) in enumerate(zip(found, one, strict=True)):
        assert row == pytest.approx(expected, rel=1e-6, abs=1e-7), f"step {step}"


if __name__ == "__main__":
    worker(int(sys.argv[1]), Path(sys.argv[2]))
