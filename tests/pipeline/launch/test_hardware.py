"""How many processes a machine's settings mean."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import pytest
import torch

from motionloom.datasets.schema import UserError
from motionloom.pipeline.launch.hardware import Hardware


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RANK", "LOCAL_WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)


def cores(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setattr("motionloom.pipeline.launch.hardware.usable_cores", lambda: count)


def test_processes_on_a_cpu_are_one_a_core_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    cores(monkeypatch, 2)
    assert Hardware().resolved_devices() == 1
    assert Hardware(cpu_devices=2).world() == 2
    assert Hardware(cpu_devices=4).resolved_devices() == 2
    assert Hardware(cpu_devices=2, devices=3).resolved_devices() == 3, "a number that is asked for is taken"
    cores(monkeypatch, 1)
    assert Hardware(cpu_devices=2).resolved_devices() == 1


def test_gpus_do_not_heed_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    cores(monkeypatch, 8)
    assert Hardware(cpu_devices=4).resolved_devices() == 1
    assert Hardware(cpu_devices=4, accelerator="cpu").resolved_devices() == 4


def test_none_is_refused() -> None:
    with pytest.raises(UserError, match="cpu_devices"):
        Hardware.parse({"cpu_devices": 0}, "hardware")


@pytest.mark.parametrize(
    ("gpus", "asked", "refused"),
    [
        (0, {"devices": 8}, True),
        (0, {"devices": 8, "accelerator": "gpu"}, True),
        (2, {"devices": 3}, True),
        (2, {"devices": 2}, False),
        (2, {}, False),
        (0, {"devices": 8, "accelerator": "cpu"}, False),
        (0, {"devices": 1}, False),
    ],
)
def test_devices_that_are_not_here_are_refused(
    gpus: int, asked: dict[str, Any], refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    with pytest.raises(UserError, match=r"hardware\.devices") if refused else nullcontext():
        Hardware.parse(asked, "hardware").require_devices()
