"""Trainings that go wrong end before a checkpoint of a lost network, or of other data, is written."""

from __future__ import annotations

import traceback
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.strategies import SingleDeviceStrategy
from rich.console import Console
from second_device import SECOND, WAITS, Far, second_device
from toy_training import ToyBatches, toy_recipe

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import ShardInfo
from motionloom.datasets.shards.checksums import LocalShard
from motionloom.models.training.finite import Failure, first_failure
from motionloom.models.training.stage_module import StageModule, StepFigures
from motionloom.pipeline.contract.stage import CompletedStage
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.process import JointError
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.continuation import newest_step
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.store.data import Data
from motionloom.pipeline.store.training_log import rise_of_loss
from motionloom.pipeline.training import execution
from motionloom.pipeline.training.config import TrainedStageConfig
from motionloom.pipeline.training.execution import deterministic
from motionloom.pipeline.training.failures import NotFiniteError, ShardWatch, StallTimer
from motionloom.pipeline.training.trainer import Training

FAILS = 13
"""Number of the batch: of step 14, between the checkpoints of steps 10 and 15."""


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patch:
        yield toy_recipe(tmp_path_factory.mktemp("crash"), patch)


def test_a_loss_that_is_not_finite_stops_the_training(recipe: Path) -> None:
    run = recipe.parent / "lost"
    with pytest.raises(NotFiniteError) as error:
        run_recipe(recipe, run, overrides=[f"toy.fails_at={FAILS}"], console=Console(quiet=True))
    stage = run / "stages/toy"
    for part in ("toy", "step 14", "recon = nan, loss = nan"):
        assert part in str(error.value)
    kept = sorted(path.name for path in (stage / "checkpoints").glob("*.ckpt"))
    assert kept == ["step=00000005.ckpt", "step=00000010.ckpt"], "no checkpoint of a lost network"


def test_a_shard_that_changes_ends_the_training_before_its_next_checkpoint(
    recipe: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is named, also where reading it has failed or a loss of what was read is not finite."""
    shards = [recipe.parent / name for name in ("one.tar", "two.tar")]
    info = ShardInfo(name="a.tar", split="train", samples=1, frames=1, bytes=1, sha256="0" * 64)
    monkeypatch.setattr(Data, "local_shards", lambda _: [LocalShard(path, info) for path in shards])
    kind = SimpleNamespace(gives=lambda _: {"data"})
    data = CompletedStage("data", cast(Any, kind), None, recipe.parent, {})
    monkeypatch.setattr("motionloom.pipeline.runs.execute.stage_inputs", lambda *_: {"data": data})
    read = ToyBatches.__getitem__

    def touched(self: ToyBatches, k: int) -> dict[str, torch.Tensor]:
        if k == FAILS:
            shards[1].write_text("longer")
        return read(self, k)

    monkeypatch.setattr(ToyBatches, "__getitem__", touched)
    never = "hardware.verify_shards=never"  # these are none
    fails = f"toy.fails_at={FAILS}"
    for sets in ([never], [never, fails], [never, fails, "toy.failure=error"]):  # the second: not finite
        for path in shards:
            path.write_text("a")
        run = recipe.parent / f"touched{len(sets)}"
        with pytest.raises(UserError, match=str(shards[1])):
            run_recipe(recipe, run, overrides=sets, console=Console(quiet=True))
        assert newest_step(run / "stages/toy") == 10
    # What all processes have found is said by the lead alone: it stays what it is.
    found, watch = JointError("found by all"), ShardWatch([data])
    shards[0].write_text("longer")
    assert watch.explain(found) is found and isinstance(watch.explain(OSError()), UserError)


def test_a_worker_that_the_system_kills_is_called_that(recipe: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(*_: object) -> None:
        raise RuntimeError("DataLoader worker (pid 25032) is killed by signal: Killed. ")

    monkeypatch.setattr(ToyBatches, "__getitem__", killed)
    with pytest.raises(UserError, match=r"toy: a loader worker was killed.*hardware\.workers"):
        run_recipe(recipe, recipe.parent / "killed", console=Console(quiet=True))


def test_a_log_folder_that_turns_read_only_ends_no_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, **_: object) -> None:
        raise PermissionError(30, "Read-only file system", str(path))

    monkeypatch.setattr(Path, "unlink", refuse)
    path = tmp_path / "stalled_rank_0.txt"
    with StallTimer(path, 60, Console(quiet=True)).running():
        assert path.exists()


def test_a_loss_that_rises_a_thousand_times_is_said() -> None:
    rows = [{"step": 10.0 * k, "train/loss": loss} for k, loss in enumerate((2.0, 1.0, 2100.0))]
    assert "1,050 times" in str(rise_of_loss([*rows, {"step": 20.0, "val/loss": 1.0}]))
    assert rise_of_loss(rows[:2]) is None and rise_of_loss([]) is None


def figures(step: int, **values: float) -> StepFigures:
    return StepFigures(step, tuple(values), torch.tensor(list(values.values())))


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("steps", "norms", "expected"),
    [
        ([figures(1, loss=1.0), figures(2, loss=2.0)], [(1, 1.0)], None),
        ([figures(1, accuracy=NAN, loss=1.0)], [], None),  # a metric may lack a value
        ([figures(3, ce=NAN, loss=NAN), figures(4, loss=NAN)], [(2, 1.0), (3, NAN)], 3),
        ([figures(3, critic_loss=INF, loss=1.0)], [], 3),
        ([figures(3, loss=1.0), figures(4, loss=NAN)], [(3, INF), (4, NAN)], 3),
    ],
)
def test_the_first_failure(steps: Any, norms: Any, expected: int | None) -> None:
    module: Any = SimpleNamespace(figures=steps, norms=[(step, torch.tensor(norm)) for step, norm in norms])
    found = first_failure(module)
    assert (found and found.step) == expected
    assert module.figures == module.norms == []


def test_the_rank_whose_own_loss_failed_comes_first() -> None:
    assert Failure(3, {"loss": NAN}).order < Failure(3).order < Failure(4, {"loss": NAN}).order


# Every stage of the baselines on a GPU, as far as a machine without one can show it (`second_device.py`).

STARTS = {
    "utt": ["utt.loss.adversarial_start=1"],
    "dance_vq": ["dance_vq.root_start=1"],
    "actor_critic": ["actor_critic.reward.actor_steps=1", "actor_critic.reward.critic_steps=1"],
    "evaluator": ["evaluator.movement_steps=1"],
}
"""Settings that have a part begin later than the first steps, by the name of kind and stage."""

ANY_ORDER = {
    "index_add", "scatter_reduce", "put", "bincount", "histc", "kthvalue", "median", "nll_loss2d_forward",
    "_embedding_bag", "grid_sampler_2d_backward", "grid_sampler_3d_backward", "_ctc_loss",
    "reflection_pad1d_backward", "reflection_pad2d_backward", "replication_pad1d_backward",
    "replication_pad2d_backward", "upsample_linear1d_backward", "upsample_bilinear2d_backward",
    "max_pool3d_with_indices_backward", "adaptive_max_pool2d_backward", "_adaptive_avg_pool2d_backward",
    "avg_pool3d_backward", "fractional_max_pool2d_backward", "max_unpool2d", "logcumsumexp",
}  # fmt: skip
"""Operations that `torch.use_deterministic_algorithms` refuses on a GPU or turns into slow ones; sums of
gradients that a gather or an index gives (scatter_add, index_put) it sorts."""

FEW = {"repeats": 1, "shuffles": 1, "count": 1, "dances": 1, "clips": 4}
"""Numbers of motions that are drawn and judged: an operation takes as long as a hundred on one device."""

MAY_WAIT = {"ActorCriticModule"}
"""Its rewards are beats of dances, which numpy finds."""


OTHERS = """
name: others
seed: 7
stages:
  data: {kind: synth}
  stats: {kind: stats}
  text: {kind: text}
  tm2t: {kind: tm2t, net: {width: 16, code_dim: 8, num_codes: 12}, critic: {start: 1, width: 8}}
  inbetween: {kind: inbetween, max_frames: 80, net: {dim: 32, ff: 32, layers: 1, heads: 2}}
"""
"""Kinds that those recipes lack; that of beats needs an instrument's sounds."""


class Anywhere(CPUAccelerator):
    """Sets up any device."""

    def setup_device(self, device: torch.device) -> None:
        """Nothing to do."""


class Watch:
    """Notes what is found in steps, by module, with the line of ours that it came from."""

    def __init__(self) -> None:
        self.module = ""
        self.found: dict[str, set[str]] = defaultdict(set)

    def __call__(self, name: str, args: Sequence[Any], out: Any) -> None:
        """See one operation."""
        if not self.module:
            return
        short = name.removeprefix("aten::").rstrip("_")
        value = args[0] if args and isinstance(args[0], torch.Tensor) else None
        far = isinstance(value, Far)
        summed = short in ("cumsum", "cumprod") and value is not None and value.is_floating_point()
        read = short in WAITS or (far and short in ("_to_copy", "to") and not isinstance(out, Far))
        if far and (short in ANY_ORDER or summed or (read and self.module not in MAY_WAIT)):
            files = ((frame.filename, frame.lineno) for frame in traceback.extract_stack())
            ours = [place for place in files if "/models/" in place[0] or "/pipeline/" in place[0]]
            self.found[self.module].add(f"{name} at {ours[-1]}")

    def follow(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Watch every training step from its batch to its end."""
        start, end = Training.on_train_batch_start, Training.on_train_batch_end

        def started(training: Training, trainer: Any, module: StageModule, *rest: Any) -> None:
            start(training, trainer, module, *rest)
            self.module = type(module).__name__

        def ended(training: Training, *rest: Any) -> None:
            self.module = ""
            end(training, *rest)

        monkeypatch.setattr(Training, "on_train_batch_start", started)
        monkeypatch.setattr(Training, "on_train_batch_end", ended)


def few_steps(recipe: str) -> list[str]:
    """Two steps of every training, on few clips, judged once; nothing waits for its first step."""
    sets = ["data.clips=40", "hardware.accelerator=cpu", "hardware.threads=1", "hardware.convert_workers=1"]
    sets += ["hardware.loggers=[]", *(["data.dances.songs=4"] if "ude" in recipe else [])]
    for stage in load_recipe(recipe).stages:
        if isinstance(stage.config, TrainedStageConfig):
            one = f"{stage.name}.train"
            sets += [f"{one}.{key}=2" for key in ("steps", "checkpoint_every", "validate_every")]
            sets += [f"{one}.batch_size=8", *STARTS.get(stage.name, ())]
        if stage.name != "data":
            fields = type(stage.config).model_fields
            sets += [f"{stage.name}.{key}={value}" for key, value in FEW.items() if key in fields]
            sets += [f"{stage.name}.sampling.denoising_steps=3"] if "sampling" in fields else []
    return sets


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("recipe", ["baselines-tiny", "baselines-tiny-ude", "others.yaml"])
def test_every_stage_runs_on_a_second_device(
    recipe: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = Watch()
    monkeypatch.chdir(tmp_path)
    Path("others.yaml").write_text(OTHERS)
    monkeypatch.setattr(execution, "strategy_of", lambda *_: SingleDeviceStrategy(SECOND))
    monkeypatch.setattr(Hardware, "lightning_accelerator", lambda self: Anywhere())
    monkeypatch.setattr(Hardware, "device", lambda self: SECOND)
    watch.follow(monkeypatch)
    with second_device(watch):
        run_recipe(recipe, tmp_path / "run", overrides=few_steps(recipe), console=Console(quiet=True))
    assert watch.found == {}


def test_the_watch_sees_any_order_and_reading() -> None:
    watch = Watch()
    with second_device(watch) as device:
        far, at = torch.ones(3).to(device), torch.tensor([0, 0, 2]).to(device)
        watch.module = "x"
        far.cumsum(0), at.cumsum(0), far.index_add(0, at, far), far.cpu()
        far.sum().item()
    assert {found.split()[0] for found in watch.found["x"]} == {
        "aten::cumsum",
        "aten::index_add",
        "aten::_to_copy",
        "aten::_local_scalar_dense",
    }


def test_a_gpu_repeats_itself_unless_told_otherwise() -> None:
    on = torch.are_deterministic_algorithms_enabled
    for hardware, wanted in ((Hardware(accelerator="gpu"), True), (Hardware(accelerator="cpu"), False)):
        with deterministic(hardware):
            assert on() == wanted
        assert not on()
    with deterministic(Hardware(accelerator="gpu", deterministic=False)):
        assert not on()
