"""One training run of a stage: Lightning's Trainer, the loader, checkpoints, logs, exact resume.

A Lightning "epoch" is here a *chunk* of `checkpoint_every` steps. Checkpoints are written at chunk ends only,
the batch of step k is a pure function of (seed, k) and every step seeds its own random draws, so a resumed
run repeats the undisturbed one bit for bit and the loader's whole state is the step number.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Iterator, Sized
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.strategies import DDPStrategy, ModelParallelStrategy, Strategy
from torch.utils.data import DataLoader, Dataset, Sampler

from motionloom.datasets.base.files import remove_temporaries
from motionloom.models.layers.transformer import Transformer
from motionloom.models.training.averaging import AveragedWeights
from motionloom.models.training.players import PlayersModule
from motionloom.models.training.sharding import make_whole
from motionloom.models.training.stage_module import StageModule
from motionloom.pipeline.contract.stage import StageContext
from motionloom.pipeline.launch.ending import end_with_parent
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.process import TeamError
from motionloom.pipeline.launch.team import environment, lead_finds
from motionloom.pipeline.stages.heartbeat import Heartbeat
from motionloom.pipeline.stages.loggers import Loggers
from motionloom.pipeline.stages.progress import MetricLog, StepProgress
from motionloom.pipeline.stages.train_config import BatchSource, EvalSource, TrainConfig
from motionloom.pipeline.store.checkpoints import SealedCheckpoints, readable

_KEPT = 2
"""Checkpoints kept: the newest, and one more in case that is torn or damaged."""


class ChunkSampler(Sampler[int]):
    """Batch numbers of one chunk, from the number that `start` tells when the chunk begins."""

    def __init__(self, start: Callable[[], int], count: int) -> None:
        self.start, self.count = start, count

    def __iter__(self) -> Iterator[int]:
        first = self.start()
        return iter(range(first, first + self.count))

    def __len__(self) -> int:
        return self.count


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
    data = _Data(train, validation, config, chunk, hardware)
    checkpoints = ModelCheckpoint(
        dirpath=context.folder / "checkpoints",
        filename="{step:08d}",
        monitor="step",
        mode="max",
        save_top_k=_KEPT,
        save_on_train_epoch_end=True,
        enable_version_counter=False,  # a torn file is written again under its own name
    )
    validate = max(1, -(-config.validate_every // chunk)) if config.validate_every and validation else None
    players = isinstance(module, PlayersModule)
    average = AveragedWeights(config.ema) if config.ema else None
    loggers = Loggers(hardware.loggers, context.folder, context.recipe, f"{context.recipe}/{context.name}")
    if hardware.resolved_accelerator() == "gpu":
        hardware.device()  # refuses in one sentence where there is no GPU
    launcher = environment()
    trainer = L.Trainer(
        default_root_dir=context.folder,
        plugins=[SealedCheckpoints(), *([launcher] if launcher else [])],
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
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        callbacks=[
            checkpoints,
            ResumeBetweenChunks(config, chunk),
            Heartbeat(context.name, context.folder, hardware.stall_seconds),
            MetricLog(context.folder, loggers),
            StepProgress(context.name, config.steps, context.console, longer=longer),
            *([average] if average else []),
        ],
    )
    prepare_module(module, config)
    if config.compile:
        module.compile_losses()
    net = module.net
    try:
        with warnings.catch_warnings():
            # Lightning compares steps with batches, and a step of players takes several.
            warnings.filterwarnings("ignore", ".*ended before the epoch ended.*")
            trainer.fit(module, datamodule=data, ckpt_path=newest, weights_only=True)
    except SystemExit:  # Lightning's answer to Ctrl-C
        raise KeyboardInterrupt from None
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(context.folder / "checkpoints")  # Lightning writes them without saying so
        raise
    except RuntimeError as error:
        if "by peer" in str(error):  # how the backends report a connection that broke
            raise TeamError(str(error)) from None
        raise
    if module.net is not net:  # the strategy has trained a sharded copy
        make_whole(module.net, net)
        module.net = net
    if average is not None:
        average.fill(net)
    if trainer.is_global_zero:
        for path in sorted((context.folder / "checkpoints").glob("*.ckpt"))[:-_KEPT]:
            path.unlink()  # Lightning forgets the checkpoint that a killed run was resumed from


def prepare_module(module: StageModule, config: TrainConfig) -> None:
    """Apply the settings that concern how the network computes."""
    module.fused = config.precision != "16-mixed"
    module.draw_by_sample = config.draws == "sample"
    if isinstance(module, PlayersModule):
        module.accumulate = config.accumulate
    for part in module.modules():
        if isinstance(part, Transformer):
            part.checkpointed = config.checkpoint_activations


class ResumeBetweenChunks(Callback):
    """Makes a resumed run begin the chunk behind its checkpoint.

    Lightning would go back into the finished epoch and, where that did not end with a validation, train one
    more batch in it: the steps of all later validations and checkpoints would move.

    Keeps in the checkpoint how the training was cut into chunks, for `start_of`.
    """

    def __init__(self, config: TrainConfig, chunk: int) -> None:
        self.steps, self.every, self.chunk = config.steps, config.checkpoint_every, chunk

    def state_dict(self) -> dict[str, Any]:
        """Length of the training, the interval that its config names, and the one in use."""
        return {"steps": self.steps, "every": self.every, "chunk": self.chunk}

    def on_load_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Mark the epoch as over and no batch of the next as taken."""
        loop = checkpoint["loops"]["fit_loop"]
        for progress in (loop["epoch_progress"]["total"], loop["epoch_progress"]["current"]):
            progress["completed"] = progress["processed"]
        batches = loop["epoch_loop.batch_progress"]
        batches["current"] = dict.fromkeys(batches["current"], 0)
        batches["is_last_batch"] = False


class _Data(L.LightningDataModule):
    def __init__(
        self,
        train: BatchSource,
        validation: EvalSource | None,
        config: TrainConfig,
        chunk: int,
        hardware: Hardware,
    ) -> None:
        super().__init__()
        self.train, self.validation = train, validation
        self.config, self.chunk, self.hardware = config, chunk, hardware

    def train_dataloader(self) -> DataLoader[Any]:
        trainer = cast(L.Trainer, self.trainer)
        micro = self.config.batch_size // self.config.accumulate
        dataset = self.train(micro, trainer.global_rank, trainer.world_size)
        parts = self.config.accumulate
        sampler = ChunkSampler(lambda: trainer.global_step * parts, self.chunk * parts)
        return _loader(dataset, sampler, self.hardware)

    def val_dataloader(self) -> DataLoader[Any] | list[Any]:
        if self.validation is None:
            return []
        dataset = self.validation()
        return _loader(dataset, range(len(cast(Sized, dataset))), self.hardware)


def _loader(dataset: Dataset[Any], sampler: Any, hardware: Hardware) -> DataLoader[Any]:
    workers = hardware.workers
    return DataLoader(
        dataset,
        batch_size=None,
        sampler=sampler,
        num_workers=workers,
        pin_memory=hardware.resolved_accelerator() == "gpu",
        persistent_workers=workers > 0,  # from chunk to chunk; their start takes seconds
        multiprocessing_context="spawn" if workers else None,
        worker_init_fn=partial(end_with_parent, os.getpid()) if workers else None,
    )


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
    been raised. Its last chunk may then have been cut short: it is trained again, so that the validations and
    checkpoints of the longer training lie where they would have without a pause.
    """
    chunk = min(config.checkpoint_every, config.steps)
    short: Start | None = None
    for path, checkpoint in readable(folder, say):
        state = checkpoint.get("callbacks", {}).get(ResumeBetweenChunks.__qualname__)
        if state is None:
            return Start(path, chunk)
        longer = state["steps"] < config.steps
        if state["every"] != config.checkpoint_every:
            return Start(path, chunk, longer)
        start = Start(path, state["chunk"], longer)
        if checkpoint["global_step"] >= config.steps or checkpoint["global_step"] % state["chunk"] == 0:
            return start
        short = short or start
    return short or Start(None, chunk)


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """Rows of a stage's `metrics.jsonl`."""
    path = folder / "metrics.jsonl"
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text().splitlines()]
