"""Any `lightning.Trainer` trains a stage's module as a loop by hand does, or refuses it in one sentence."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch
import ude_training
from lightning.pytorch import callbacks as given
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.tuner import Tuner
from plain_training import StopAt, take_steps, trainer
from rank_cases import CASES
from same_stage import assert_equal
from tiny_adversaries import Duel, Vectors, train
from torch.utils.data import DataLoader
from two_ranks import pair_of, work

from motionloom.datasets.base.errors import UserError
from motionloom.models.training.averaging import AveragedWeights
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.training.config import CALLBACKS, TrainConfig, TrainingCallback
from motionloom.pipeline.training.loaders import StageData
from motionloom.pipeline.training.trained_stage import Batches

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


def stage_data(name: str, parts: int = 1) -> StageData:
    """As a stage gives it."""
    clips: Any = Vectors if name == "duel" else ude_training.Clips
    batches = Batches(
        lambda *place: clips(*place, dtype=torch.float32, dies_at=None),
        lambda: clips(8, size=2, dtype=torch.float32, dies_at=None),
    )
    return StageData(batches, TrainConfig(steps=STEPS, batch_size=8, accumulate=parts))


NAMES = dict.fromkeys((*CASES, *ude_training.NAMES, "duel"))


@pytest.mark.parametrize("parts", [1, 2])
@pytest.mark.parametrize("name", NAMES)
def test_a_trainer_equals_a_loop_by_hand(name: str, parts: int, tmp_path: Path) -> None:
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


@pytest.mark.parametrize("name", ["mq", "utt", "actor_critic", "duel"])
def test_resumes_from_its_checkpoint_and_monitors(
    name: str, tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    """With an average of the weights, and no word about loaders that cannot be resumed."""
    whole, module, resumed = (opened(name)[0] for _ in range(3))
    for one in (whole, module, resumed):
        one.ema = 0.9
    trainer(tmp_path).fit(whole, stage_data(name))
    keep = given.ModelCheckpoint(tmp_path, filename="best", monitor="val/loss", every_n_train_steps=3)
    watch = {
        "callbacks": [keep, given.LearningRateMonitor(), StopAt(3)],
        "logger": CSVLogger(tmp_path),
        "log_every_n_steps": 1,
    }
    first = trainer(tmp_path, enable_checkpointing=True, val_check_interval=3, **watch)
    first.fit(module, stage_data(name))
    assert keep.best_model_path == str(tmp_path / "best.ckpt") and first.global_step == 3
    assert first.callback_metrics["val/loss"].isfinite() and first.callback_metrics["train/loss"].isfinite()
    rates = (tmp_path / "lightning_logs/version_0/metrics.csv").read_text().splitlines()[0].split(",")
    assert any(name.startswith("lr-") for name in rates)
    trainer(tmp_path).fit(resumed, stage_data(name), ckpt_path=keep.best_model_path)
    assert_equal(whole.state_dict(), resumed.state_dict())
    said = [str(one.message) for one in recwarn]
    assert not [one for one in said if "not resumable" in one or "__len__" in one]


@pytest.mark.parametrize("name", ["mq", "utt"])
def test_epochs_go_on_where_the_last_one_ended(name: str, tmp_path: Path) -> None:
    """Also one that a limit ends, and one in which a training stops and goes on."""
    whole, short, stopped, resumed = (opened(name)[0] for _ in range(4))
    trainer(tmp_path, max_steps=2 * STEPS).fit(whole, stage_data(name))
    trainer(tmp_path, max_steps=2 * STEPS, limit_train_batches=2).fit(short, stage_data(name))
    assert_equal(whole.state_dict(), short.state_dict())
    epochs: dict[str, Any] = {"max_steps": -1, "max_epochs": 2}
    half = trainer(tmp_path, **epochs, callbacks=[StopAt(STEPS + 2, tmp_path / "half.ckpt")])
    half.fit(stopped, data := stage_data(name))
    assert half.global_step == STEPS + 2
    trainer(tmp_path, **epochs).fit(resumed, data, ckpt_path=tmp_path / "half.ckpt")
    assert resumed.step == 2 * STEPS
    assert_equal(whole.state_dict(), resumed.state_dict())


# All that a Trainer takes.

Row = tuple[dict[str, Any], str]
SAME, OTHER, ENDS = "without effect on the weights", "taken over", "taken over, with other weights or steps"


def arguments(folder: Path) -> dict[str, Row]:
    """Every argument of a Trainer, set to what may matter, and what comes of it: one of the above, or the
    words of the refusal.
    """
    epoch: dict[str, Any] = {"max_steps": -1, "max_epochs": 1}
    clip: dict[str, Any] = {"gradient_clip_val": 1e-3}
    same: dict[str, Any] = {
        "accelerator": "cpu", "devices": 1, "num_nodes": 1, "logger": CSVLogger(folder), "callbacks": [],
        "min_epochs": 1, "min_steps": 2, "max_time": {"minutes": 9}, "limit_train_batches": 2,
        "limit_val_batches": 1, "limit_test_batches": 1, "limit_predict_batches": 1, "val_check_interval": 3,
        "num_sanity_val_steps": 1, "log_every_n_steps": 1, "enable_checkpointing": True,
        "enable_progress_bar": True, "enable_model_summary": True, "deterministic": True, "benchmark": True,
        "inference_mode": False, "use_distributed_sampler": True, "profiler": "simple",
        "detect_anomaly": True, "barebones": True, "plugins": [], "sync_batchnorm": True,
        "default_root_dir": folder, "enable_autolog_hparams": False, "model_registry": "a/b",
    }  # fmt: skip
    return {name: ({name: value}, SAME) for name, value in same.items()} | {
        "strategy": ({"strategy": "ddp_spawn"}, "ddp_spawn.*take strategy ddp"),
        "precision": ({"precision": "16-true"}, "precision 16-true: take one of"),
        "fast_dev_run": ({"fast_dev_run": True}, ENDS),
        "max_epochs": (epoch, SAME),
        "max_steps": ({"max_steps": 9}, ENDS),
        "overfit_batches": ({"overfit_batches": 1}, OTHER),
        "check_val_every_n_epoch": ({"check_val_every_n_epoch": None, "val_check_interval": 3}, SAME),
        "accumulate_grad_batches": ({"accumulate_grad_batches": 2}, OTHER),
        "gradient_clip_val": (clip, OTHER),
        "gradient_clip_algorithm": (clip | {"gradient_clip_algorithm": "value"}, OTHER),
        "reload_dataloaders_every_n_epochs": (epoch | {"reload_dataloaders_every_n_epochs": 1}, SAME),
    }


class Freezing(given.BaseFinetuning):
    """Freezes the decoder."""

    def freeze_before_training(self, pl_module: Any) -> None:
        self.freeze(pl_module.net.decoder)

    def finetune_function(self, *_: Any) -> None:
        """Nothing is thawed."""


def callbacks(folder: Path) -> dict[str, Row]:
    """Every callback of Lightning's, likewise."""
    logged, shown = {"logger": CSVLogger(folder)}, {"enable_progress_bar": True}
    summed = {"enable_model_summary": True}
    plain = ("Callback", "LambdaCallback", "Timer")
    kept = {"enable_checkpointing": True}
    made: dict[str, tuple[Any, dict[str, Any], str]] = {
        name: (getattr(given, name)(), {}, SAME) for name in plain
    } | {
        "Checkpoint": (given.Checkpoint(), kept, SAME),
        "BackboneFinetuning": (given.BackboneFinetuning(), {}, "backbone"),
        "BaseFinetuning": (Freezing(), {}, OTHER),
        "BasePredictionWriter": (given.BasePredictionWriter(), {}, SAME),
        "BatchSizeFinder": (given.BatchSizeFinder(), {}, "Field batch_size not found"),
        "DeviceStatsMonitor": (given.DeviceStatsMonitor(cpu_stats=False), logged, SAME),
        "EarlyStopping": (given.EarlyStopping("val/loss"), {"val_check_interval": 3}, SAME),
        "GradientAccumulationScheduler": (given.GradientAccumulationScheduler({0: 2}), {}, "equally many"),
        "LearningRateFinder": (given.LearningRateFinder(num_training_steps=8), {}, ENDS),
        "LearningRateMonitor": (given.LearningRateMonitor(), logged, SAME),
        "ModelCheckpoint": (given.ModelCheckpoint(folder), kept, SAME),
        "ModelPruning": (given.ModelPruning("l1_unstructured", amount=0.1), {}, ENDS),
        "ModelSummary": (given.ModelSummary(), summed, SAME),
        "OnExceptionCheckpoint": (given.OnExceptionCheckpoint(folder), kept, SAME),
        "ProgressBar": (given.TQDMProgressBar(), shown, SAME),
        "RichModelSummary": (given.RichModelSummary(), summed, SAME),
        "RichProgressBar": (given.RichProgressBar(), shown, SAME),
        "StochasticWeightAveraging": (
            given.StochasticWeightAveraging(1e-3, swa_epoch_start=1), {"max_steps": -1, "max_epochs": 2}, ENDS
        ),
        "SpikeDetection": (given.SpikeDetection(exclude_batches_path=folder / "spikes"), {}, SAME),
        "ThroughputMonitor": (given.ThroughputMonitor(lambda batch: 8), logged, SAME),
        "TQDMProgressBar": (given.TQDMProgressBar(), shown, SAME),
        "EMAWeightAveraging": (given.EMAWeightAveraging(), {}, "AveragedWeights"),
        "WeightAveraging": (given.WeightAveraging(), {}, "AveragedWeights"),
    }  # fmt: skip
    return {name: ({"callbacks": [one], **more}, come) for name, (one, more, come) in made.items()}


ARGUMENTS = dict.fromkeys(inspect.signature(L.Trainer.__init__).parameters.keys() - {"self"})
ALL = [*sorted(ARGUMENTS), *sorted(given.__all__)]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ALL)
def test_all_that_a_trainer_takes(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A new argument or callback of Lightning's fails here until the tables say what comes of it."""
    monkeypatch.chdir(tmp_path)
    settings, come = (arguments(tmp_path) | callbacks(tmp_path))[name]
    plain, module = opened("mq")[0], opened("mq")[0]
    trainer(tmp_path).fit(plain, stage_data("mq"))
    try:
        if come not in (SAME, OTHER, ENDS):
            with pytest.raises(Exception, match=come):
                trainer(tmp_path, **settings).fit(module, stage_data("mq"))
            return
        trainer(tmp_path, **settings).fit(module, stage_data("mq"))
    finally:
        torch.use_deterministic_algorithms(False)
        torch.backends.cudnn.benchmark = False
    assert all(value.isfinite().all() for value in module.state_dict().values())
    if come != ENDS:
        equal = all(map(torch.equal, plain.state_dict().values(), module.state_dict().values()))
        assert module.step == STEPS and equal == (come == SAME)


def test_a_trainer_that_counts_otherwise_says_so(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"train\.accumulate is 2; what counts is this Trainer's, 1"):
        trainer(tmp_path, max_steps=1).fit(opened("mq")[0], stage_data("mq", parts=2))
    with pytest.warns(UserWarning, match=r"train\.precision is 32-true; .* bf16-mixed"):
        trainer(tmp_path, max_steps=1, precision="bf16-mixed").fit(opened("mq")[0], stage_data("mq"))


@pytest.mark.parametrize(
    "settings", [{"max_steps": 12}, {"max_steps": -1, "max_epochs": 2}, {"max_steps": 4}]
)
def test_the_schedule_is_as_long_as_the_trainer(settings: dict[str, Any], tmp_path: Path) -> None:
    """The critic's cosine ends with the last step, in parts as well."""
    for parts in (1, 2):
        module = Duel(seed=3, max_steps=STEPS, start=0)
        wanted = settings["max_steps"] if settings["max_steps"] > 0 else 12
        module.accumulate = parts
        with pytest.warns(UserWarning, match=f"takes {wanted} steps and the module was made for 6"):
            trainer(tmp_path, **settings).fit(module, stage_data("duel", parts))
        critic = module._turns[1]
        assert module.step == wanted and critic.group.factor(wanted, max_steps=wanted) == 0
        assert critic.schedule.lr_lambdas[0](wanted) == pytest.approx(0, abs=1e-9)
        assert critic.schedule.lr_lambdas[0](wanted - 1) > 0


def test_a_rate_is_found_and_the_training_is_as_without(tmp_path: Path) -> None:
    module, plain = opened("mq")[0], opened("mq")[0]
    one = trainer(tmp_path)
    found = Tuner(one).lr_find(module, stage_data("mq"), num_training=8, update_attr=False)
    assert found is not None and len(found.results["lr"]) == 8
    one.fit(module, stage_data("mq"))
    trainer(tmp_path).fit(plain, stage_data("mq"))
    assert_equal(plain.state_dict(), module.state_dict())
    module.lr = 0.5
    assert module.optim_config.lr == 0.5


def tokenizer_batch() -> dict[str, Any]:
    return {"motion": torch.randn(8, 20, 75), "length": torch.full((8,), 20)}


BATCHES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "lacks length": (lambda batch: {"motion": batch["motion"]}, "reads 'length'"),
    "lacks motion": (lambda batch: {"length": batch["length"]}, "reads 'motion'"),
    "float64": (lambda batch: batch | {"motion": batch["motion"].double()}, "float64"),
    "no frames": (lambda batch: batch | {"length": batch["length"] * 0}, "above 0"),
    "too long": (lambda batch: batch | {"length": batch["length"] + 1}, "says 21 frames"),
    "nan": (lambda batch: batch | {"motion": batch["motion"] * torch.nan}, "step 1 the loss is not finite"),
}


@pytest.mark.parametrize("what", BATCHES)
def test_own_batches_that_are_wrong_get_a_sentence(what: str, tmp_path: Path) -> None:
    change, words = BATCHES[what]
    data = DataLoader([change(tokenizer_batch())] * STEPS, batch_size=None)
    for kind in ("mq", "tm2t"):
        with pytest.raises(UserError, match=words):
            trainer(tmp_path).fit(opened(kind)[0], data)


@pytest.mark.filterwarnings("ignore")
def test_what_a_module_is_not_for_is_refused(tmp_path: Path) -> None:
    module, data = opened("mq")[0], DataLoader([tokenizer_batch()] * STEPS, batch_size=None)
    for how in ("test", "predict"):
        with pytest.raises(UserError, match=rf"trainer\.{how}: .*trainer\.validate"):
            getattr(trainer(tmp_path), how)(module, data)
    assert trainer(tmp_path).validate(module, data)[0]["val/loss"] > 0
    for precision in ("bf16-true", "16-mixed"):
        plugin = L.pytorch.plugins.MixedPrecision("16-mixed", "cpu", torch.amp.GradScaler("cpu"))
        settings = {"plugins": [plugin]} if precision == "16-mixed" else {"precision": precision}
        with pytest.raises(UserError, match=f"precision {precision}"):
            trainer(tmp_path, **settings).fit(module, data)
    with pytest.raises(UserError, match=r"module\.compile_losses\(\)"):
        trainer(tmp_path).fit(torch.compile(module, backend="eager"), data)


def test_an_average_leaves_tables_and_codebooks_alone(tmp_path: Path) -> None:
    """At every decay: they are those of a training without; the weights do not move here."""

    def still(*callbacks: L.Callback) -> torch.nn.Module:
        module, batches = opened("h2vq")
        module.optim_config = module.optim_config.model_copy(update={"lr": 1e-12, "weight_decay": 0.0})
        data = DataLoader([batches(k) for k in range(4)], batch_size=None)
        trainer(tmp_path, max_steps=4, callbacks=list(callbacks)).fit(module, data)
        return module.net

    plain, first = still(), opened("h2vq")[0].net
    for decay in (0.9, 0.95, 0.999, 0.9999):
        net = still(AveragedWeights(decay))
        assert_equal(dict(plain.named_buffers()), dict(net.named_buffers()))
        for param, before in zip(net.parameters(), first.parameters(), strict=True):
            torch.testing.assert_close(param, before, rtol=0, atol=1e-9)


def test_a_recipe_names_callbacks_and_a_profiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A callback sees validations as under any Trainer, and ends the training behind the second."""
    early = TrainingCallback("early", lambda _: given.EarlyStopping("val/loss", min_delta=1e9, patience=1))
    monkeypatch.setitem(CALLBACKS._things, "early", early)
    duel = train(tmp_path, validate_every=6, callbacks=("early",), profiler="simple")
    assert duel.step == 12
    assert "run_training_batch" in next((tmp_path / "logs").glob("*profile*")).read_text()
    with pytest.raises(ValueError, match="did you mean 'early'"):
        TrainConfig(callbacks=("earli",))


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
def test_two_processes_equal_those_of_the_pipeline(pair: Path) -> None:
    assert {path.name for path in pair.glob("done*")} == {"done0", "done1"}


if __name__ == "__main__":
    work(worker)
