"""One training run of a stage: Lightning's Trainer, the loader, checkpoints, logs, exact resume.

A Lightning "epoch" is here a *chunk* of `checkpoint_every` steps. Checkpoints are written at chunk ends and
where a signal interrupts the training, the batch of step k is a pure function of (seed, k) and every step
seeds its own random draws, so a resumed run repeats the undisturbed one bit for bit and the loader's whole
state is the step number. Chunks end without a pause: the reader goes on over their borders, and checkpoints
are written beside the training.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import lightning as L
import torch
from lightning.pytorch.strategies import DDPStrategy, ModelParallelStrategy, Strategy

from motionloom.datasets.base.files import remove_temporaries
from motionloom.models.layers.transformer import Transformer
from motionloom.models.training.averaging import AveragedWeights
from motionloom.models.training.players import PlayersModule
from motionloom.models.training.sharding import make_whole
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.contract.stage import StageContext
from motionloom.pipeline.flight.branch import require_branch
from motionloom.pipeline.flight.callbacks import flight_callbacks
from motionloom.pipeline.flight.waits import Waits
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.process import TeamError
from motionloom.pipeline.launch.team import environment, lead_finds
from motionloom.pipeline.stages.heartbeat import Heartbeat
from motionloom.pipeline.stages.interruption import Interruption, Signals, leave_signals_alone
from motionloom.pipeline.stages.loading import TrainingData
from motionloom.pipeline.stages.loggers import Loggers
from motionloom.pipeline.stages.progress import MetricLog, StepProgress
from motionloom.pipeline.stages.saving import ROW, Checkpoints, ResumeBetweenChunks, SealedCheckpoints
from motionloom.pipeline.stages.train_config import BatchSource, EvalSource, TrainConfig
from motionloom.pipeline.store.background import BackgroundWriter, step_of
from motionloom.pipeline.store.checkpoints import readable


def fit(
    context: StageContext,
    module: StageModule,
    config: TrainConfig,
    train: BatchSource,
    validation: EvalSource | None,
    grad_clip: float,
) -> None:
    """Train `module` for `config.steps`, resuming from the newest good checkpoint in the stage's folder."""
    hardware = context.hardware
    if hardware.threads:
        torch.set_num_threads(hardware.threads)
    newest, chunk, longer = lead_finds(partial(_start, context, config))
    if config.branch is not None:
        require_branch(context.name, config.branch.step, config.steps, newest, module)
    waits, folder = Waits(), context.folder / "checkpoints"
    validate = max(1, -(-config.validate_every // chunk)) if config.validate_every and validation else None
    players = isinstance(module, PlayersModule)
    average = AveragedWeights(config.ema) if config.ema else None
    loggers = Loggers(hardware.loggers, context.folder, context.recipe, f"{context.recipe}/{context.name}")
    log = MetricLog(context.folder, loggers)
    since = step_of(newest) if newest else None
    writer = BackgroundWriter(keep=config.keep_checkpoints, keep_every=config.keep_every, since=since)
    checkpoints = Checkpoints(folder, writer, waits, log.saved)
    signals = Signals()
    stop = Interruption(context.name, config.steps, chunk, config.accumulate, signals, checkpoints, log)
    data = TrainingData(train, validation, config, chunk, hardware, waits, stop.cuts_validation)
    if hardware.resolved_accelerator() == "gpu":
        hardware.device()  # refuses in one sentence where there is no GPU
    launcher = environment()
    trainer = L.Trainer(
        default_root_dir=context.folder,
        plugins=[SealedCheckpoints(writer), *([launcher] if launcher else [])],
        accelerator=hardware.lightning_accelerator(),
        devices=hardware.resolved_devices(),
        num_nodes=hardware.nodes,
        strategy=_strategy(hardware, config),
        precision=config.precision,
        max_steps=config.steps,
        # Players gather the parts of a step themselves, and clip the gradients of each.
        accumulate_grad_batches=1 if players else config.accumulate,
        gradient_clip_val=None if players else grad_clip or None,
        check_val_every_n_epoch=validate or 1,
        limit_val_batches=1.0 if validate else 0,
        num_sanity_val_steps=0,
        logger=False,
        enable_checkpointing=False,  # Lightning's own; `Checkpoints` saves
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        callbacks=[
            checkpoints,  # first: what is being written ends before the loggers do
            *flight_callbacks(
                context,
                train,
                steps=config.steps,
                batch_size=config.batch_size,
                accumulate=config.accumulate,
                on_not_finite=config.on_not_finite,
                branched=config.branch is not None,
                waits=waits,
                settle=checkpoints.finish,
            ),
            ResumeBetweenChunks(config, chunk, config.accumulate),
            Heartbeat(context.name, context.folder, hardware.stall_seconds),
            log,
            StepProgress(context.name, config.steps, context.console, longer=longer),
            *([average] if average else []),
            stop,  # last: what all others do at the end of a step is in the checkpoint of an interruption
        ],
    )
    leave_signals_alone(trainer)
    prepare_module(module, config)
    if config.compile:
        module.compile_losses()
    net = module.net
    try:
        with signals, warnings.catch_warnings():
            # Lightning compares steps with batches, and a step of players takes several.
            warnings.filterwarnings("ignore", ".*ended before the epoch ended.*")
            trainer.fit(module, datamodule=data, ckpt_path=newest, weights_only=True)
    except SystemExit:  # Lightning's answer to Ctrl-C
        raise KeyboardInterrupt from None
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(folder)
        raise
    except RuntimeError as error:
        if "by peer" in str(error):  # how the backends report a connection that broke
            raise TeamError(str(error)) from None
        raise
    finally:
        data.close()
    if module.net is not net:  # the strategy has trained a sharded copy
        make_whole(module.net, net)
        module.net = net
    if average is not None:
        average.fill(net)


def prepare_module(module: StageModule, config: TrainConfig) -> None:
    """Apply the settings that concern how the network computes."""
    module.fused = config.precision != "16-mixed"
    module.draw_by_sample = config.draws == "sample"
    if isinstance(module, PlayersModule):
        module.accumulate = config.accumulate
    for part in module.modules():
        if isinstance(part, Transformer):
            part.checkpointed = config.checkpoint_activations


def _strategy(hardware: Hardware, config: TrainConfig) -> str | Strategy:
    if hardware.world() == 1:
        return "auto"
    if config.strategy == "fsdp":
        return ModelParallelStrategy(
            data_parallel_size=hardware.world(),
            tensor_parallel_size=1,
            # One file with everything, as DDP writes it: a run may be resumed with the other strategy.
            save_distributed_checkpoint=False,
            process_group_backend=hardware.backend(),
        )
    return DDPStrategy(
        process_group_backend=hardware.backend(),
        # The quantizers keep codebooks equal themselves; rank 0's copy must not overwrite them mid-step.
        forward_sync_buffers=False,
    )


class Start(NamedTuple):
    """Where a training begins."""

    checkpoint: Path | None
    """What to go on from; None for the beginning."""
    chunk: int
    """Steps of a chunk."""
    longer: bool = False
    """Whether the checkpoint is of a training of fewer steps."""


def _start(context: StageContext, config: TrainConfig) -> Start:
    """Where the stage begins; done by the lead, once what a killed run was writing is gone."""
    folder = context.folder / "checkpoints"
    if folder.is_dir():
        remove_temporaries(folder)
    say = partial(context.console.print, style="yellow", markup=False, soft_wrap=True)
    return start_of(folder, config, say)


def start_of(folder: Path, config: TrainConfig, say: Callable[[str], None] = warnings.warn) -> Start:
    """Where a training with these checkpoints begins; `say` is given why any was passed over.

    It keeps the chunks that it began with as long as `checkpoint_every` is the same, also when `steps` has
    been raised, so that the validations and checkpoints of the longer training lie where they would have
    without a pause. A checkpoint in the middle of a chunk that does not say how far the log's next row had
    come (older versions wrote one where a training's last chunk was cut short) gives way to one at a border.
    """
    chunk = min(config.checkpoint_every, config.steps)
    short: Start | None = None
    for path, checkpoint in readable(folder, say):
        state = checkpoint.get("callbacks", {}).get(ResumeBetweenChunks.__qualname__)
        if state is None:
            return Start(path, chunk)
        longer, step = state["steps"] < config.steps, checkpoint["global_step"]
        if state["every"] != config.checkpoint_every:
            return Start(path, chunk, longer)
        start = Start(path, state["chunk"], longer)
        if step >= config.steps or step % state["chunk"] == 0 or ROW in checkpoint:
            return start
        short = short or start
    return short or Start(None, chunk)


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """Rows of a stage's `metrics.jsonl`."""
    path = folder / "metrics.jsonl"
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text().splitlines()]
