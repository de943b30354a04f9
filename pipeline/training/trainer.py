"""The training loop of a stage, on Lightning Fabric: steps, validation, checkpoints, logs, exact resume.

The batch of step k is a pure function of (seed, k) and every step seeds its own random draws, so a resumed
training repeats the undisturbed one bit for bit, and the loader's whole state is the step number. Checkpoints
are written in the background every `checkpoint_every` steps, at the end, and when a signal interrupts the
training.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path

import lightning as L
import torch
import torch.distributed as dist
from lightning.fabric import Fabric
from torch import Tensor

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import remove_temporaries
from motionloom.datasets.base.os_errors import full_place
from motionloom.models.training.averaging import AveragedWeights
from motionloom.models.training.distributed import rank, world_size
from motionloom.models.training.stage_module import LOG_EVERY, Batch, StageModule
from motionloom.pipeline.contract.stage import StageContext
from motionloom.pipeline.launch.process import Interrupted, TeamError
from motionloom.pipeline.launch.team import lead_finds
from motionloom.pipeline.store.training_log import optional, rise_of_loss
from motionloom.pipeline.training.checkpointing import (
    BackgroundWriter,
    Checkpoint,
    load_optimizer,
    load_row,
    load_weights,
    name_of,
    optimizer_state,
    read_checkpoint,
    readable,
    rows_of_ranks,
    step_of,
    weights_of,
)
from motionloom.pipeline.training.config import BatchSource, EvalSource, TrainConfig
from motionloom.pipeline.training.execution import Execution, deterministic, launch, set_threads
from motionloom.pipeline.training.failures import FailureGuard, ShardWatch, StallTimer
from motionloom.pipeline.training.loaders import TrainingData, on_device
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
    fabric = launch(hardware, config)
    resume = lead_finds(partial(_find_resume_point, context))
    net = module.net
    training = Training(
        context, module, config, fabric, TrainingData(train, validation, config, hardware), resume
    )
    try:
        with deterministic(hardware):
            training.run()
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = full_place(error, training.folder)
        raise
    except RuntimeError as error:
        if isinstance(error, dist.DistBackendError) or "by peer" in str(error) or "imed out" in str(error):
            raise TeamError.lost(training.log.folder) from None
        if "killed by signal: Killed" in str(error):
            raise UserError(
                f"stage {context.name}: a loader worker was killed, as systems do that are short of memory; "
                f"lower hardware.workers and run the same command, which goes on from the last checkpoint"
            ) from error
        if "does not have a deterministic implementation" in str(error):
            what = str(error).partition(",")[0]
            raise UserError(f"stage {context.name}: {what}; set hardware.deterministic: false") from error
        raise
    if module.net is not net:  # a sharded copy was trained
        whole = weights_of(module.net)
        if rank() == 0:
            net.load_state_dict(whole)
        module.net = net
    if training.average is not None:
        training.average.fill(net)
    module.to("cpu")


class Training:
    """One training of a stage, in this process."""

    def __init__(
        self,
        context: StageContext,
        module: StageModule,
        config: TrainConfig,
        fabric: Fabric,
        data: TrainingData,
        resume: Path | None,
    ) -> None:
        """`resume` is the checkpoint to go on from; None for the beginning."""
        self.context, self.module, self.config, self.fabric, self.data = context, module, config, fabric, data
        self.folder = context.folder / "checkpoints"
        console, name, hardware = context.console, context.name, context.hardware
        self.every = min(config.checkpoint_every, config.steps)
        # Validations fall on checkpoints, so that a resumed training makes the same ones.
        checkpoints = -(-config.validate_every // self.every)
        self.validate_every = checkpoints * self.every if data.validation is not None else 0
        peak, at_peak = peak_flops(fabric.device, config.precision), 0.0
        if peak is not None:
            with optional(f"MFU of {name}", console):
                module.on_fit_start()  # frozen networks were loaded to the GPU, and the rest is not there yet
                at_peak = config.accumulate * pass_flops(module, data.train[0]) / peak
        self.execution = Execution(fabric, module, config)
        self.average = AveragedWeights(module.net, config.ema) if config.ema else None
        title = f"{context.recipe}/{name}"
        self.log = MetricLog(context.folder, hardware.loggers, context.recipe, title, console)
        self.validation_is_due = False
        # Loaded before telemetry and writer begin: both go on from the module's step.
        if resume is not None:
            self._load(read_checkpoint(resume))
        context.begun()
        self.writer = BackgroundWriter(keep=config.keep_checkpoints, keep_every=config.keep_every)
        sample_every = -(-config.sample_every // self.every) * self.every
        self.samples = SampleProcess(context, sample_every)
        self._saved, self._writing = module.step if resume else -1, False
        self.telemetry = Telemetry(context.folder, module, config.batch_size, console, at_peak)
        self.failures = FailureGuard(name, module)
        self.shards = ShardWatch(context.inputs.values())
        stalled = self.log.folder / f"stalled_rank_{rank()}.txt"
        self.stall = StallTimer(stalled, hardware.stall_seconds, console)

    def run(self) -> None:
        self.log.open()
        self.progress = StepProgress(
            self.context.name, self.module.step, self.config.steps, self.context.console
        )
        with Signals() as self.signals, self.stall.running():
            self.agreement = Agreement(self.signals, world_size())
            self.signals.ends_compiling = self._end_compiling
            try:
                self._run()
            except BaseException as error:
                with suppress(UserError, OSError):  # the error says more than one of the writing
                    self._finish_writing()
                self.log.fail()
                if isinstance(error, Exception):
                    raise self.shards.explain(error) from error
                raise
            finally:
                self.progress.close()
                self.data.close()
        summary = self.telemetry.summary()
        if summary:
            self.context.console.print(f"    {self.context.name}: {summary}")
        if rank() == 0 and (risen := rise_of_loss(self.log.rows)):
            self.context.console.print(f"[yellow]    {self.context.name}: {risen}[/]", soft_wrap=True)

    def _run(self) -> None:
        module, steps = self.module, self.config.steps
        # A signal cut the validation of this step short: its row comes before those of later steps.
        if self.validation_is_due:
            self._validate()
            if not self.validation_is_due:
                self._save(again=True)  # else a second kill would validate this step twice
            self._answer(self.agreement.now())
        left = self.data.batches(module.step) if module.step < steps else ()
        batches = on_device(left, self.fabric)
        while module.step < steps:
            self._step(batches)
            border = module.step % self.every == 0 or module.step == steps
            if self.validate_every and module.step % self.validate_every == 0:
                self._validate()
            if border:  # after the validation, so that the checkpoint holds its row
                self._save()
            self._answer(self.agreement.now() if border else self.agreement.after_step())
        self._finish_writing()
        # A signal during the last write: the run must not go on to the next stage.
        self._answer(self.agreement.now())
        self.log.finish()

    def _step(self, batches: Iterator[Batch]) -> None:
        self.telemetry.begin_step()
        loss = self.execution.take_step(self._parts(batches))
        step = self.module.step
        if self.average is not None:
            self.average.update(self.module.net)
        self.telemetry.end_step()
        if self.failures.due(step):
            self.failures.check()
        if step % LOG_EVERY == 0:
            self._log_row()
        self.progress.show(step, loss, self.telemetry.note)
        if self._writing and not self.writer.busy:
            self._finish_writing()
        self.stall.progress()

    def _parts(self, batches: Iterator[Batch]) -> Iterator[Batch]:
        """Yield the parts of one step's batch, each read when it is needed."""
        for _ in range(self.config.accumulate):
            with self.telemetry.waits.waiting_for("data"):
                batch = next(batches)
            self.telemetry.batch(batch)
            yield batch

    def _log_row(self) -> None:
        """Log the means of the last ten steps over all ranks."""
        means = self.module.take_row()
        if world_size() > 1 and means:
            values = torch.stack(list(means.values()))
            dist.all_reduce(values)
            means = dict(zip(means, (values / world_size()).unbind(), strict=True))
        gauges = _numbers(self.module.gauges) | self.telemetry.end_row()
        self.log.append(self.module.step, _numbers(means), gauges)

    def _validate(self) -> None:
        """Log the mean losses on all held-out batches, weighted by rows; a signal ends it after a batch."""
        module, loader = self.module, self.data.held_out()
        # Weights that are not finite would make the validation a figure that nobody can read.
        self.failures.check()
        # Frozen parts stay in evaluation: modes are restored part by part.
        modes = [(part, part.training) for part in module.modules()]
        module.eval()
        sums: dict[str, Tensor] = {}
        rows, cut = 0, False
        self.agreement.restart_pace()  # batches of a validation take another time than steps
        averaged = self.average.swapped(module.net) if self.average else nullcontext()
        with self.telemetry.waits.waiting_for("validation"), averaged, torch.no_grad():
            for number, batch in enumerate(on_device(loader, self.fabric)):
                with self.fabric.autocast():
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
        self.validation_is_due = cut
        if not cut:
            self.log.append(module.step, _numbers({f"val/{k}": v / rows for k, v in sums.items()}), {})

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
            state = self._state()
            if rank() == 0:
                self.writer.write(state, self.folder / name_of(step))
                self._writing = True
        self._saved = step
        self.stall.progress()

    def _finish_writing(self) -> None:
        """Wait until the checkpoint is on disk; `UserError` if it could not be written."""
        self.writer.finish()
        if self._writing:
            self._writing = False
            self.log.saved(self._saved)
            self.samples.saved(self._saved)

    def _state(self) -> Checkpoint:
        module = self.module
        return {
            "global_step": module.step,
            "steps": self.config.steps,
            "state_dict": weights_of(module),
            "optimizer_states": [
                optimizer_state(module, optimizer) for optimizer in self.execution.optimizers
            ],
            "average": None if self.average is None else self.average.state_dict(),
            "log": self.log.state_dict(),
            "row": rows_of_ranks(module),
            "hyper_parameters": dict(module.hparams),
            "validate": self.validation_is_due,
            "pytorch-lightning_version": L.__version__,
            "epoch": 0,
        }

    def _load(self, state: Checkpoint) -> None:
        module, name = self.module, self.context.name
        # Data and random draws need no state: both are functions of the seed and the step.
        module.step = state["global_step"]
        try:
            load_weights(module, state["state_dict"])
            for optimizer, one in zip(self.execution.optimizers, state["optimizer_states"], strict=True):
                load_optimizer(module, optimizer, one)
        except (RuntimeError, ValueError) as error:  # torch names every tensor that does not fit
            raise UserError(
                f"{self.folder / name_of(module.step)}: holds another network than {name} has now "
                f"({str(error).splitlines()[-1].strip()[:200]}); give the settings that it began with, or "
                f"begin anew with --from {name}"
            ) from None
        average = state["average"]
        if self.config.ema and average is None:  # it begins now, with these weights
            self.average = AveragedWeights(module.net, self.config.ema)
        elif self.average is not None and average is not None:
            self.average.load_state_dict(average)
        self.log.load_state_dict(state["log"])
        load_row(module, state["row"])
        self.validation_is_due = state["validate"]
        if rank() == 0:
            longer = state["steps"] < self.config.steps
            begins = f"{name} continues from" if longer else f"resuming {name} at"
            self.context.console.print(f"    {begins} step {module.step} of {self.config.steps}")


def _numbers(values: dict[str, Tensor] | dict[str, float | Tensor]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items()}


def _at_least_float32(value: Tensor) -> Tensor:
    return value if value.dtype in (torch.float32, torch.float64) else value.float()


def _find_resume_point(context: StageContext) -> Path | None:
    """Return the newest checkpoint that can be read, in the lead; temporary and damaged files are deleted."""
    folder = context.folder / "checkpoints"
    if folder.is_dir():
        remove_temporaries(folder)
    say = partial(context.console.print, style="yellow", markup=False, soft_wrap=True)
    newest = next((path for path, _ in readable(folder, say)), None)
    for path in folder.glob("*.ckpt"):
        if newest is not None and (step_of(path) or 0) > (step_of(newest) or 0):
            path.unlink()  # damaged: the training writes this step again
    return newest
