"""Loaders beside the training: how many workers, and batches that are copied while others are computed."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_adversaries import Vectors
from torch.utils._pytree import tree_flatten
from torch.utils.data._utils.pin_memory import pin_memory

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.os_errors import sentence_of
from motionloom.datasets.conditions import Condition
from motionloom.datasets.loading.shared import SharedBatches
from motionloom.datasets.loading.steps import Steps
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.training import loaders
from motionloom.pipeline.training.config import TrainConfig
from motionloom.pipeline.training.loaders import StageData, on_device
from motionloom.pipeline.training.trained_stage import Batches

GIB = 2**30


@pytest.mark.parametrize(
    ("settings", "cores", "shared", "batches", "wanted"),
    [
        ({"accelerator": "gpu", "devices": 1}, 16, 8 * GIB, 1000, 4),
        ({"accelerator": "gpu", "devices": 8}, 24, 8 * GIB, 1000, 2),
        ({"accelerator": "gpu", "devices": 8}, 8, 8 * GIB, 1000, 0),
        ({"accelerator": "gpu", "devices": 2}, 64, GIB, 1000, 2),
        ({"accelerator": "gpu", "devices": 1}, 64, 2**26, 1000, 0),
        ({"accelerator": "gpu", "devices": 1}, 64, None, 1000, 0),
        ({"accelerator": "gpu", "devices": 1}, 16, 8 * GIB, 20, 0),
        ({"accelerator": "cpu"}, 16, 8 * GIB, 1000, 0),
        ({"accelerator": "cpu", "workers": 3}, 1, 0, 1, 3),
        ({"accelerator": "gpu", "devices": 1, "workers": 0}, 16, 8 * GIB, 1000, 0),
    ],
)
def test_workers_by_cores_processes_and_shared_memory(
    settings: dict[str, Any],
    cores: int,
    shared: int | None,
    batches: int,
    wanted: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def usage(path: str) -> SimpleNamespace:
        if shared is None:
            raise FileNotFoundError(path)
        return SimpleNamespace(free=shared)

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr(shutil, "disk_usage", usage)
    assert Hardware.parse(settings, "hardware").workers_for(batches) == wanted


@pytest.mark.parametrize("workers", [-1, "many"])
def test_other_workers_are_refused(workers: object) -> None:
    with pytest.raises(UserError, match="workers"):
        Hardware.parse({"workers": workers}, "hardware")


def test_shared_memory_that_takes_no_batch_ends_the_training_and_its_workers() -> None:
    """A limit on the size of files stands for memory that is full."""
    hardware = Hardware(accelerator="cpu", workers=2)
    data = StageData(Batches(lambda *_: Vectors(2**12), None), TrainConfig(steps=8), hardware)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**14, before[1]))
    try:
        with pytest.raises(RuntimeError) as caught:
            next(iter(data.train_dataloader()))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "hardware.workers" in str(sentence_of(caught.value))
    data.teardown()  # while the error still holds the iterator
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("rooms", [0, 2])
def test_batches_of_a_worker_lie_in_one_piece_of_shared_memory(
    rooms: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any types, shapes and nesting come back from torch's sending and pinning; memory is used again."""
    monkeypatch.setattr(torch.Tensor, "pin_memory", torch.Tensor.clone)
    draw = torch.Generator().manual_seed(0)

    def batch(rows: int) -> dict[str, Any]:
        text = Condition(torch.randn(rows, 3, 5, generator=draw), torch.ones(rows, 3) > 0, None)
        return {
            "motion": torch.randn(rows, 7, generator=draw).mT, "present": torch.rand(rows, 3) > 0.5,
            "length": torch.arange(rows), "none": torch.empty(0, 4), "one": torch.tensor(2.5).double(),
            "caption": ["a", "b"], "full": True, "conditions": {"text": text},
        }  # fmt: skip

    given = [batch(rows) for rows in (3, 2, 1, 5, 4)]
    seen = []
    for wanted, packed in zip(given, SharedBatches(Steps(lambda *_: given, 5), rooms), strict=True):
        sent = pin_memory(pickle.loads(ForkingPickler.dumps(packed))).unpacked()
        seen.append(packed.memory)
        assert packed.memory.is_shared()
        (leaves, shape), (expected, expected_shape) = tree_flatten(sent), tree_flatten(wanted)
        assert shape == expected_shape, "a condition is one again"
        for value, own in zip(leaves, expected, strict=True):
            equal = value == own if not isinstance(own, torch.Tensor) else value.equal(own)
            assert equal and type(value) is type(own)
            assert getattr(value, "dtype", None) is getattr(own, "dtype", None)
    assert (seen[0].data_ptr() == seen[2].data_ptr()) is bool(rooms), "the third fits where the first was"
    assert seen[2].data_ptr() != seen[4].data_ptr()


def test_the_next_batch_is_copied_while_one_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU's calls: batch 1 is on its way before batch 0 is given out, and each is waited for."""
    calls: list[object] = []
    now = ["computing"]

    class Stream:
        def __init__(self, name: object) -> None:
            self.name = str(name) if isinstance(name, str) else "copies"

        def record_event(self) -> str:
            return f"copy {sum(str(call).startswith('copy') for call in calls) - 1}"

        def wait_event(self, event: str) -> None:
            calls.append(f"{self.name} waits for {event}")

    @contextmanager
    def within(stream: Stream) -> Iterator[None]:
        now.append(stream.name)
        yield
        now.pop()

    def to_device(batch: dict[str, Any], device: torch.device) -> dict[str, Any]:
        assert now[-1] == "copies"
        calls.append(f"copy {int(batch['motion'])}")
        return batch

    kept = []
    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "stream", within)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda _: Stream(now[-1]))
    monkeypatch.setattr(torch.Tensor, "record_stream", lambda tensor, stream: kept.append(stream.name))
    monkeypatch.setattr(loaders, "move_data_to_device", to_device)
    given = [
        {"motion": torch.tensor(k), "conditions": {"text": Condition(torch.zeros(1), torch.ones(1))}}
        for k in range(3)
    ]
    for k, batch in enumerate(on_device(given, torch.device("cuda"))):
        assert batch is given[k]
        calls.append(f"compute {k}")
        assert kept == 3 * (k + 1) * ["computing"], "memory of every tensor is held back"
    assert calls == [
        "copy 0", "copy 1", "computing waits for copy 0", "compute 0",
        "copy 2", "computing waits for copy 1", "compute 1",
        "computing waits for copy 2", "compute 2",
    ]  # fmt: skip
    reading = iter(on_device(map(calls.append, range(2)), torch.device("cpu")))
    assert next(reading) is None and calls[-1] == 0, "a CPU reads no batch before its turn"


def test_a_worker_imports_no_lightning(tmp_path: Path) -> None:
    """What a worker is sent opens without it, which takes seconds and 200 MB in each of dozens of workers."""
    ones = {"motion": torch.ones(2)}
    (tmp_path / "sent").write_bytes(pickle.dumps(SharedBatches(Steps(lambda *_: {0: ones, 1: ones}, 2), 0)))
    code = (
        "import pathlib, pickle, sys; batches = pickle.loads(pathlib.Path(sys.argv[1]).read_bytes()); "
        "print(len(list(batches)), 'lightning' in sys.modules, 'motionloom.pipeline' in sys.modules)"
    )
    command = [sys.executable, "-P", "-c", code, str(tmp_path / "sent")]
    found = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert found.split() == ["2", "False", "False"]
