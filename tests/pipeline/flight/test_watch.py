"""The first step that is not finite is found, with its terms and layers, when a row ends."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import nn

from motionloom.pipeline.flight.groups import LayerGroups, group_of, read_norms
from motionloom.pipeline.flight.watch import Failure, Watch, failure_of

NAMES = ("loss", "recon")


class Net(nn.Module):
    """Two groups, and a critic beside the network."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Module()
        self.net.encoder, self.net.scale = nn.Linear(2, 2), nn.Parameter(torch.ones(1))
        self.critic = nn.Linear(2, 1)
        for param in self.parameters():
            param.grad = torch.full_like(param, 0.5)


def watch(net: Net, *, scaled: bool = False, device: str = "cpu") -> tuple[Watch, Any]:
    """On a module of which only its step, device and parameters are asked for."""
    module = SimpleNamespace(
        global_step=0, ends_row=False, device=torch.device(device), named_parameters=net.named_parameters
    )
    return Watch(module, keep=20, scaled=scaled), module  # type: ignore[arg-type]


def step(seen: Watch, module: Any, number: int, loss: float, norm: float, params: Any) -> None:
    module.global_step, module.ends_row = number - 1, number % 10 == 0
    seen.figures(NAMES, torch.tensor([loss, 1.0]))
    seen.gradients(params, torch.tensor(norm))


def test_groups_are_children_of_the_network_and_other_networks() -> None:
    names = ["net.encoder.0.weight", "net.scale", "critic.2.bias"]
    assert [group_of(name) for name in names] == ["encoder", "net", "critic"]
    net = Net()
    norms = read_norms(LayerGroups(net).gradient_norms(net.parameters()))
    assert norms == pytest.approx({"net": 0.5, "encoder": 0.5 * math.sqrt(6), "critic": 0.5 * math.sqrt(3)})


def test_the_first_step_counts_and_its_layers_are_kept() -> None:
    net = Net()
    seen, module = watch(net)
    params = list(net.parameters())
    for number in range(1, 4):
        step(seen, module, number, 1.0, 1.0, params)
    net.critic.weight.grad = torch.full((1, 2), math.inf)
    step(seen, module, 4, math.nan, math.nan, params)
    for param in params:
        param.grad = torch.full_like(param, math.nan)
    step(seen, module, 5, math.nan, math.nan, params)
    assert seen.collect() == Failure(4, True, pytest.approx({"loss": math.nan}, nan_ok=True), ("critic",))
    assert seen.collect() is None
    assert [number for number, _ in seen.recent] == [1, 2, 3, 4, 5]


def test_a_gradient_alone_is_found_where_no_scaler_expects_it() -> None:
    for scaled in (False, True):
        net = Net()
        seen, module = watch(net, scaled=scaled)
        step(seen, module, 1, 1.0, math.inf, list(net.parameters()))
        found = seen.collect()
        assert found == (None if scaled else Failure(1, False))


def test_nothing_is_read_from_a_gpu_before_a_row_ends() -> None:
    """There the first step is known and its layers are not."""
    net = Net()
    seen, module = watch(net, device="meta")
    net.critic.weight.grad = torch.full((1, 2), math.nan)
    step(seen, module, 1, math.nan, math.nan, list(net.parameters()))
    found = seen.collect()
    assert found is not None and (found.step, found.groups) == (1, ())


def test_of_several_processes_the_earliest_counts_and_a_loss_before_its_gradients() -> None:
    found = [Failure(5, False), Failure(4, False), Failure(4, True), Failure(5, True)]
    assert sorted(found, key=lambda failure: failure.code) == [found[2], found[1], found[3], found[0]]


def test_only_losses_must_be_finite() -> None:
    assert failure_of(1, {"loss": [1.0], "accuracy": [math.nan]}) is None
    found = failure_of(2, {"generator_loss": [1.0, math.inf], "loss": [1.0], "margin": [math.nan]})
    assert found is not None and list(found.terms) == ["margin", "generator_loss"]
    assert found.say() == "the loss is not finite (margin = nan, generator_loss = inf)"
