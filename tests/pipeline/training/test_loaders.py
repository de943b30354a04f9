"""Loaders beside the training: how many workers, and batches that are copied while others are computed."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import resource
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning as L
import pytest
import torch
import ude_training
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.plugins import MixedPrecision
from plain_training import take_steps
from rank_cases import CASES
from same_stage import assert_equal
from tiny_adversaries import Duel, Vectors
from torch.utils._pytree import tree_flatten
from torch.utils.data import DataLoader
from torch.utils.data._utils.pin_memory import pin_memory
from two_ranks import pair_of, work

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.os_errors import sentence_of
from motionloom.datasets.conditions import Condition
from motionloom.datasets.loading.steps import Steps
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.training.config import TrainConfig
from motionloom.pipeline.training.lightning_data import StageData
from motionloom.pipeline.training.loaders import SharedBatches, TrainingData, on_device
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


@pytest.mark.parametrize(("workers", "wanted"), [("auto", 0), (2, 2)])
def test_a_script_starts_workers_only_when_told(workers: int | str, wanted: int) -> None:
    hardware = Hardware.parse({"accelerator": "gpu", "devices": 1, "workers": workers}, "hardware")
    batches: Any = Batches(lambda *_: [{}] * 1000, None)
    data = StageData(batches, TrainConfig(), hardware)
    assert data.hardware.workers_for(1000) == wanted


@pytest.mark.parametrize("workers", [-1, "many"])
def test_other_workers_are_refused(workers: object) -> None:
    with pytest.raises(UserError, match="workers"):
        Hardware.parse({"workers": workers}, "hardware")


def test_shared_memory_that_takes_no_batch_ends_the_training_and_its_workers() -> None:
    """A limit on the size of files stands for memory that is full."""
    hardware = Hardware(accelerator="cpu", workers=2)
    data = TrainingData(lambda *_: Vectors(2**12), None, TrainConfig(steps=8), hardware)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**14, before[1]))
    try:
        with pytest.raises(RuntimeError) as caught:
            next(iter(data.batches(0)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "hardware.workers" in str(sentence_of(caught.value))
    data.close()  # while the error still holds the iterator
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

    def to_device(batch: dict[str, Any]) -> dict[str, Any]:
        assert now[-1] == "copies"
        calls.append(f"copy {int(batch['motion'])}")
        return batch

    kept = []
    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "stream", within)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda _: Stream(now[-1]))
    monkeypatch.setattr(torch.Tensor, "record_stream", lambda tensor, stream: kept.append(stream.name))
    fabric: Any = SimpleNamespace(device=torch.device("cuda"), to_device=to_device)
    given = [
        {"motion": torch.tensor(k), "conditions": {"text": Condition(torch.zeros(1), torch.ones(1))}}
        for k in range(3)
    ]
    for k, batch in enumerate(on_device(given, fabric)):
        assert batch is given[k]
        calls.append(f"compute {k}")
        assert kept == 3 * (k + 1) * ["computing"], "memory of every tensor is held back"
    assert calls == [
        "copy 0", "copy 1", "computing waits for copy 0", "compute 0",
        "copy 2", "computing waits for copy 1", "compute 1",
        "computing waits for copy 2", "compute 2",
    ]  # fmt: skip
    on_cpu: Any = SimpleNamespace(device=torch.device("cpu"), to_device=lambda batch: batch)
    reading = iter(on_device(map(calls.append, range(2)), on_cpu))
    assert next(reading) is None and calls[-1] == 0, "a CPU reads no batch before its turn"


# `lightning.Trainer` and the pipeline's own loop train every kind of module to the same bits.

STEPS = 6
Opened = tuple[StageModule, Callable[[int], dict[str, Any]]]


def opened(name: str) -> Opened:
    """A module on small networks with made-up batches."""
    torch.manual_seed(0)
    if name in CASES and name not in ude_training.NAMES:
        module, batches = CASES[name]()
        module.net.double()
        return module, batches
    if name == "duel":
        return Duel(seed=3, max_steps=STEPS), Vectors(8).__getitem__
    clips = ude_training.Clips(8, dtype=torch.float32, dies_at=None)
    return ude_training.module_of(name, STEPS, dropout=0.1), clips.__getitem__


def trainer(folder: Path, **settings: Any) -> L.Trainer:
    """One that prints and logs nothing."""
    quiet: dict[str, Any] = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    given = {"max_steps": STEPS, "accelerator": "cpu", "default_root_dir": folder, **quiet, **settings}
    return L.Trainer(**{"enable_checkpointing": False, **given})


NAMES = dict.fromkeys((*CASES, *ude_training.NAMES, "duel"))


@pytest.mark.parametrize("parts", [1, 2])
@pytest.mark.parametrize("name", NAMES)
def test_a_trainer_equals_the_own_loop(name: str, parts: int, tmp_path: Path) -> None:
    (own, batch), (module, same) = opened(name), opened(name)
    own.accumulate = module.accumulate = parts
    take_steps(own, [batch(k) for k in range(STEPS * parts)])
    data = DataLoader([same(k) for k in range(STEPS * parts)], batch_size=None)
    settings = {"accumulate_grad_batches": parts} if module.automatic_optimization else {}
    trainer(tmp_path, **settings).fit(module, data)
    assert own.step == module.step == STEPS
    assert_equal(own.state_dict(), module.state_dict())


@pytest.mark.parametrize("name", ["mq", "utt", "actor_critic", "duel"])
def test_in_half_precision(name: str, tmp_path: Path) -> None:
    (own, batch), (module, same) = opened(name), opened(name)
    take_steps(own, [batch(k) for k in range(STEPS)], "bf16-mixed")
    data = DataLoader([same(k) for k in range(STEPS)], batch_size=None)
    trainer(tmp_path, precision="bf16-mixed").fit(module, data)
    assert_equal(own.state_dict(), module.state_dict())
    scaled = MixedPrecision("16-mixed", "cpu", torch.amp.GradScaler("cpu"))
    with pytest.raises(UserError, match="bf16-mixed"):
        trainer(tmp_path, plugins=[scaled]).fit(module, data)


def stage_data(name: str, parts: int = 1) -> StageData:
    """As a stage gives it."""
    clips: Any = Vectors if name == "duel" else ude_training.Clips
    batches = Batches(
        lambda *place: clips(*place, dtype=torch.float32, dies_at=None),
        lambda: clips(8, size=2, dtype=torch.float32, dies_at=None),
    )
    return StageData(batches, TrainConfig(steps=STEPS, batch_size=8, accumulate=parts))


@pytest.mark.parametrize("name", ["mq", "utt", "actor_critic", "duel"])
def test_resumes_from_its_checkpoint_and_monitors(name: str, tmp_path: Path) -> None:
    whole, module, resumed = (opened(name)[0] for _ in range(3))
    trainer(tmp_path).fit(whole, stage_data(name))
    keep = ModelCheckpoint(tmp_path, filename="best", monitor="val/loss", every_n_train_steps=3)
    watch = {
        "callbacks": [keep, LearningRateMonitor()],
        "logger": CSVLogger(tmp_path),
        "log_every_n_steps": 1,
    }
    first = trainer(tmp_path, max_steps=3, enable_checkpointing=True, val_check_interval=3, **watch)
    first.fit(module, stage_data(name))
    assert keep.best_model_path == str(tmp_path / "best.ckpt")
    assert first.callback_metrics["val/loss"].isfinite() and first.callback_metrics["train/loss"].isfinite()
    rates = (tmp_path / "lightning_logs/version_0/metrics.csv").read_text().splitlines()[0].split(",")
    assert any(name.startswith("lr-") for name in rates)
    trainer(tmp_path).fit(resumed, stage_data(name), ckpt_path=keep.best_model_path)
    assert_equal(whole.state_dict(), resumed.state_dict())


@pytest.mark.parametrize("name", ["mq", "utt"])
def test_epochs_go_on_where_the_last_one_ended(name: str, tmp_path: Path) -> None:
    """Also one that a limit ends, and one in which a training stops and goes on."""
    whole, short, stopped, resumed = (opened(name)[0] for _ in range(4))
    trainer(tmp_path, max_steps=2 * STEPS).fit(whole, stage_data(name))
    trainer(tmp_path, max_steps=2 * STEPS, limit_train_batches=2).fit(short, stage_data(name))
    assert_equal(whole.state_dict(), short.state_dict())
    epochs: dict[str, Any] = {"max_steps": -1, "max_epochs": 2}
    half = trainer(tmp_path, **{**epochs, "max_steps": STEPS + 2})
    half.fit(stopped, data := stage_data(name))
    half.save_checkpoint(tmp_path / "half.ckpt")
    assert half.global_step == STEPS + 2
    trainer(tmp_path, **epochs).fit(resumed, data, ckpt_path=tmp_path / "half.ckpt")
    assert resumed.step == 2 * STEPS
    assert_equal(whole.state_dict(), resumed.state_dict())


def test_a_trainer_that_counts_otherwise_says_so(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"train\.accumulate is 2; what counts is this Trainer's, 1"):
        trainer(tmp_path, max_steps=1).fit(opened("mq")[0], stage_data("mq", parts=2))
    with pytest.warns(UserWarning, match=r"train\.precision is 32-true; .* bf16-mixed"):
        trainer(tmp_path, max_steps=1, precision="bf16-mixed").fit(opened("mq")[0], stage_data("mq"))


def worker(folder: Path) -> None:
    for name in ude_training.NAMES:
        own = ude_training.train(name, folder / name, devices=2, dropout=0.1, steps=STEPS, validate_every=0)
        module = ude_training.module_of(name, STEPS, dropout=0.1)
        trainer(folder, devices=2, strategy="ddp", use_distributed_sampler=True).fit(module, stage_data(name))
        assert_equal(own.state_dict(), module.state_dict())
    (folder / f"done{os.environ['RANK']}").touch()


pair = pair_of(__file__)


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_two_processes_equal_the_own_loop_on_two(pair: Path) -> None:
    assert {path.name for path in pair.glob("done*")} == {"done0", "done1"}


if __name__ == "__main__":
    work(worker)
