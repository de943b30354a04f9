"""The training of a stage by a `lightning.Trainer`: validation, checkpoints, logs, exact resume.

The batch of step k is a pure function of (seed, k) and every step seeds its own random draws, so a resumed
training repeats the undisturbed one bit for bit, and the loader's whole state is the step number. Checkpoints
are written in the background every `checkpoint_every` steps, at the end, and when a signal interrupts the
training.
"""

from __future__ import annotations

import signal
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext, suppress
from functools import partial
from typing import Any

import lightning as L
import torch
import torch.distributed as dist
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.loading.plan import Share
from motionloom.models.training.averaging import AveragedWeights
from motionloom.models.training.distributed import rank, world_size
from motionloom.models.training.finite import check_is_due
from motionloom.models.training.stage_module import LOG_EVERY, StageModule
from motionloom.pipeline.contract.stage import StageContext
from motionloom.pipeline.launch.process import Interrupted, TeamError
from motionloom.pipeline.launch.team import lead_finds
from motionloom.pipeline.store.training_log import optional, rise_of_loss
from motionloom.pipeline.training.checkpointing import (
    BackgroundWriter,
    find_resume_point,
    load_row,
    name_of,
    rows_of_ranks,
)
from motionloom.pipeline.training.config import CALLBACKS, Batches, BatchSource, EvalSource, TrainConfig
from motionloom.pipeline.training.execution import (
    compile_module,
    deterministic,
    make_trainer,
    prepare_module,
    set_threads,
)
from motionloom.pipeline.training.failures import FailureGuard, ShardWatch, StallTimer, explained
from motionloom.pipeline.training.loaders import StageData
from motionloom.pipeline.training.metric_log import MetricLog
from motionloom.pipeline.training.preemption import Agreement, Signals
from motionloom.pipeline.training.telemetry import SampleProcess, StepProgress, Telemetry
from motionloom.pipeline.training.utilization import pass_flops, peak_flops


def fit(
    context: StageContext,
    module: StageModule,
    config: TrainConfig,
    train: BatchSource,
    validation: EvalSource | None,
) -> None:
    """Train `module` for `config.steps`, resuming from the newest good checkpoint in the stage's folder."""
    hardware = context.hardware
    set_threads(module, hardware)
    if hardware.resolved_accelerator() == "gpu":
        hardware.device()  # refuses in one sentence where there is no GPU
    prepare_module(module, config)
    at_peak = _seconds_at_peak(context, module, config, train)
    compile_module(module, config, hardware)
    module.logs_rows = True
    writer = BackgroundWriter(keep=config.keep_checkpoints, keep_every=config.keep_every)
    data = StageData(Batches(train, validation), config, hardware)
    average = AveragedWeights(config.ema) if config.ema else None
    extra = [CALLBACKS[name].make(context) for name in config.callbacks]
    with Signals() as signals:
        training = Training(context, config, data, writer, average, extra, signals, at_peak)
        callbacks = [*([] if average is None else [average]), *extra, training]
        trainer = make_trainer(hardware, config, module, callbacks, writer, training.metrics.folder)
        resume = lead_finds(partial(find_resume_point, training.folder, context.console))
        try:
            with deterministic(hardware):
                trainer.fit(module, data, ckpt_path=resume, weights_only=True)
        except SystemExit:
            if training.ended_by_user:  # Lightning makes an exit of it
                raise KeyboardInterrupt from None
            raise
        except Exception as error:
            told = explained(training.shards.explain(error), context.name, training.metrics.folder, resume)
            if told is error:
                raise
            raise told from (None if isinstance(told, TeamError) else error)
        finally:
            training.close()
    module.to("cpu")
    training.sum_up(module)


def _seconds_at_peak(
    context: StageContext, module: StageModule, config: TrainConfig, train: BatchSource
) -> float:
    """Return the seconds that a step would take at the device's peak; 0 where that is not known."""
    peak = peak_flops(context.hardware.device(), config.precision)
    if peak is not None:
        with optional(f"MFU of {context.name}", context.console):
            module.on_fit_start()  # frozen networks were loaded to the GPU, and the rest is not there yet
            batch = train(config.batch_size, Share(0, context.hardware.world(), config.accumulate))[0]
            return config.accumulate * pass_flops(module, batch) / peak
    return 0.0


class Training(L.Callback):
    """What surrounds the steps of one training in this process: rows, validations, checkpoints, signals."""

    telemetry: Telemetry
    progress: StepProgress
    failures: FailureGuard
    agreement: Agreement
    stall: StallTimer
    _step: int
    """Steps that are done and seen to."""

    def __init__(
        self,
        context: StageContext,
        config: TrainConfig,
        data: StageData,
        writer: BackgroundWriter,
        average: AveragedWeights | None,
        extra: Sequence[L.Callback],
        signals: Signals,
        at_peak: float,
    ) -> None:
        self.context = context
        self.config = config
        self.data = data
        self.writer = writer
        self.average = average
        self.extra = extra
        self.signals = signals
        self.at_peak = at_peak
        self.folder = context.folder / "checkpoints"
        console = context.console
        name = context.name
        hardware = context.hardware
        self.every = min(config.checkpoint_every, config.steps)
        # Validations fall on checkpoints, so that a resumed training makes the same ones.
        checkpoints = -(-config.validate_every // self.every)
        self.validate_every = checkpoints * self.every if data.batches.validation is not None else 0
        title = f"{context.recipe}/{name}"
        self.metrics = MetricLog(context.folder, hardware.loggers, context.recipe, title, console)
        self.shards = ShardWatch(context.inputs.values())
        self.ended_by_user = False
        self._open: ExitStack | None = None
        self._restored: dict[str, Any] | None = None
        self._saved = -1
        self._writing = False
        self._validation_is_due = False

    # Lightning's hooks, in the order of their calls.

    def on_fit_start(self, trainer: L.Trainer, module: Any) -> None:
        self.signals.hold()

    def on_load_checkpoint(self, trainer: L.Trainer, module: Any, checkpoint: dict[str, Any]) -> None:
        self._restored = {key: checkpoint[key] for key in ("row", "steps", "validate")}
        self.metrics.load_state_dict(checkpoint["log"])

    def on_train_start(self, trainer: L.Trainer, module: Any) -> None:
        self._begin(trainer, module)

    def on_train_batch_start(self, trainer: L.Trainer, module: Any, batch: Any, batch_idx: int) -> None:
        self.telemetry.batch(batch)

    def on_train_batch_end(
        self, trainer: L.Trainer, module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """After the last part of a step: its row, validation and checkpoint, and what signals ask for."""
        step = module.step
        if step == self._step:
            return
        self._step = step
        self.telemetry.end_step()
        if check_is_due(step, module.device):
            self.failures.check()
        if step % LOG_EVERY == 0:
            self._log_row()
        loss = outputs["loss"] * trainer.accumulate_grad_batches if "loss" in outputs else torch.zeros(())
        self.progress.show(step, loss, self.telemetry.note)
        if self._writing and not self.writer.busy:
            self._finish_writing()
        self.stall.progress()
        border = step % self.every == 0 or step == self.config.steps
        if self.validate_every and step % self.validate_every == 0:
            self._validate()
        if border:  # after the validation, so that the checkpoint holds its row
            self._save()
        self._answer(self.agreement.now() if border else self.agreement.after_step())
        self.telemetry.begin_step()

    def on_save_checkpoint(self, trainer: L.Trainer, module: Any, checkpoint: dict[str, Any]) -> None:
        checkpoint |= {
            "steps": self.config.steps,
            "log": self.metrics.state_dict(),
            "row": rows_of_ranks(module),
            "validate": self._validation_is_due,
            "average": checkpoint.get("average"),
        }

    def on_train_end(self, trainer: L.Trainer, module: Any) -> None:
        self._finish_writing()
        # A signal during the last write: the run must not go on to the next stage.
        self._answer(self.agreement.now())
        self.metrics.finish()

    def on_fit_end(self, trainer: L.Trainer, module: Any) -> None:
        """Finish a training that was killed behind its last step, for which a Trainer has nothing to do."""
        if self._open is None:
            module.to(trainer.strategy.root_device)
            self._begin(trainer, module)
            self.on_train_end(trainer, module)

    def on_exception(self, trainer: L.Trainer, module: Any, exception: BaseException) -> None:
        self.ended_by_user = isinstance(exception, KeyboardInterrupt)
        with suppress(UserError, OSError):  # the error says more than one of the writing
            self._finish_writing()
        self.metrics.fail()

    def close(self) -> None:
        """End what shows and watches the steps."""
        if self._open is not None:
            self._open.close()

    def sum_up(self, module: StageModule) -> None:
        """Print speed and waits, and that the loss has risen."""
        console = self.context.console
        name = self.context.name
        if summary := self.telemetry.summary():
            console.print(f"    {name}: {summary}")
        if rank() == 0 and (risen := rise_of_loss(self.metrics.rows)):
            console.print(f"[yellow]    {name}: {risen}[/]", soft_wrap=True)

    def _begin(self, trainer: L.Trainer, module: StageModule) -> None:
        """Open logs and watches at the step that the training goes on from."""
        context = self.context
        config = self.config
        console = self.context.console
        self.trainer = trainer
        self.module = module
        self._step = module.step
        self.signals.note()
        if self.average is not None and self.average.average is None:
            self.average.begin(module.net)
        if self._restored is not None:
            load_row(module, self._restored["row"])
            self._saved = module.step
            self._validation_is_due = self._restored["validate"]
            longer = self._restored["steps"] < config.steps
            begins = f"{context.name} continues from" if longer else f"resuming {context.name} at"
            if rank() == 0:
                console.print(f"    {begins} step {module.step} of {config.steps}")
        context.begun()
        sample_every = -(-config.sample_every // self.every) * self.every
        self.samples = SampleProcess(context, sample_every)
        self.telemetry = Telemetry(context.folder, module, config.batch_size, console, self.at_peak)
        self.failures = FailureGuard(context.name, module)
        self.metrics.open()
        self.progress = StepProgress(context.name, module.step, config.steps, console)
        self.agreement = Agreement(self.signals, world_size())
        self.signals.ends_compiling = self._end_compiling
        stalled = self.metrics.folder / f"stalled_rank_{rank()}.txt"
        self.stall = StallTimer(stalled, context.hardware.stall_seconds, console)
        self._open = ExitStack()
        self._open.callback(self.progress.close)
        self._open.enter_context(self.stall.running())
        self.data.waiting = partial(self.telemetry.waits.waiting_for, "data")
        # A signal cut the validation of this step short: its row comes before those of later steps.
        if self._validation_is_due:
            self._validate()
            if not self._validation_is_due:
                self._save(again=True)  # else a second kill would validate this step twice
            self._answer(self.agreement.now())
        self.telemetry.begin_step()

    def _log_row(self) -> None:
        """Log the means of the last ten steps over all ranks."""
        means = self.module.take_row()
        if world_size() > 1 and means:
            values = torch.stack(list(means.values()))
            dist.all_reduce(values)
            means = dict(zip(means, (values / world_size()).unbind(), strict=True))
        gauges = _numbers(self.module.gauges) | self.telemetry.end_row()
        self._append(_numbers(means), gauges)

    def _append(self, figures: dict[str, float], gauges: dict[str, float]) -> None:
        self.metrics.append(self.module.step, figures, gauges)
        if self.extra:  # they look for figures where a Trainer has them
            self.module.log_dict(figures)

    def _validate(self) -> None:
        """Log the mean losses on all held-out batches, weighted by rows; a signal ends it after a batch."""
        module = self.module
        trainer = self.trainer
        loader = self.data.val_dataloader()
        assert not isinstance(loader, list)
        # Weights that are not finite would make the validation a figure that nobody can read.
        self.failures.check()
        # Frozen parts stay in evaluation: modes are restored part by part.
        modes = [(part, part.training) for part in module.modules()]
        module.eval()
        sums: dict[str, Tensor] = {}
        rows = 0
        cut = False
        self.agreement.restart_pace()  # batches of a validation take another time than steps
        averaged = self.average.swapped(module.net) if self.average else nullcontext()
        with self.telemetry.waits.waiting_for("validation"), averaged, torch.no_grad():
            for number, batch in enumerate(loader):
                batch = trainer.strategy.batch_to_device(batch, module.device)
                with trainer.precision_plugin.val_step_context():
                    values = module.validation_step(batch, number)
                size = len(batch["length"])
                rows += size
                sums = {k: sums.get(k, 0.0) + _at_least_float32(v) * size for k, v in values.items()}
                self.stall.progress()
                if number + 1 < len(loader) and self.agreement.after_step():
                    cut = True
                    break
        self.agreement.restart_pace()
        for part, mode in modes:
            part.training = mode
        self._validation_is_due = cut
        if not cut:
            self._append(_numbers({f"val/{k}": v / rows for k, v in sums.items()}), {})
            for callback in self.extra:
                callback.on_validation_end(trainer, module)

    def _answer(self, number: int) -> None:
        """Save this step and raise `Interrupted` if any rank has got a signal."""
        if not number:
            return
        self.signals.answered = True
        # Saved whatever the step: `checkpoint_every` is what a kill may cost, a signal costs nothing.
        self._save()
        self._finish_writing()
        self.agreement.barrier()  # nobody leaves before the file is whole
        raise self._interrupted(number)

    def _end_compiling(self, number: int) -> Interrupted | None:
        """Return the error that ends the process while torch compiles; None if steps would be lost."""
        return self._interrupted(number) if self.module.step in (0, self._saved) else None

    def _interrupted(self, number: int) -> Interrupted:
        name = signal.Signals(number).name
        return Interrupted(self.context.name, self.module.step, self.config.steps, name)

    def _save(self, *, again: bool = False) -> None:
        """Save this step unless it is saved (`again`: in any case); every rank calls it."""
        step = self.module.step
        if step == self._saved and not again:
            return
        # No checkpoint of a lost network, nor of other data than the training began with.
        self.failures.check()
        self.shards.check(self.module.device)
        with self.telemetry.waits.waiting_for("checkpoints"):
            self._finish_writing()  # at most one copy of the state is in memory
            self.trainer.save_checkpoint(self.folder / name_of(step), weights_only=False)
            self._writing = rank() == 0
        self._saved = step
        self.stall.progress()

    def _finish_writing(self) -> None:
        """Wait until the checkpoint is on disk; `UserError` if it could not be written."""
        self.writer.finish()
        if self._writing:
            self._writing = False
            self.metrics.saved(self._saved)
            self.samples.saved(self._saved)
            self.context.saved()


def _numbers(values: dict[str, Tensor] | dict[str, float | Tensor]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items()}


def _at_least_float32(value: Tensor) -> Tensor:
    return value if value.dtype in (torch.float32, torch.float64) else value.float()
