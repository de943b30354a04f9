"""The callbacks of this room, as one training needs them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

from lightning.pytorch.callbacks import Callback
from torch.utils.data import Dataset

from motionloom.pipeline.contract.stage import StageContext
from motionloom.pipeline.flight.branch import OwnSettings
from motionloom.pipeline.flight.bundles import Bundles
from motionloom.pipeline.flight.not_finite import NotFinite
from motionloom.pipeline.flight.profiler import StepProfiler
from motionloom.pipeline.flight.recorder import FlightRecorder, FlightSettings
from motionloom.pipeline.flight.waits import Waits


def flight_callbacks(
    context: StageContext,
    train: Callable[[int, int, int], Dataset[Any]],
    *,
    steps: int,
    batch_size: int,
    accumulate: int,
    on_not_finite: Literal["stop", "continue"],
    branched: bool,
    waits: Waits,
    settle: Callable[[], None],
) -> list[Callback]:
    """What stands before all other callbacks of a training, the log of its figures among them.

    `waits` is where the training counts what it waits for; `settle` returns when the checkpoint
    that is being written is on disk.
    """
    own: list[Callback] = [OwnSettings()] if branched else []
    if context.watched_by:
        return [*own, *context.watched_by]
    hardware = context.hardware
    settings = FlightSettings(
        name=context.name,
        folder=context.folder,
        batch_size=batch_size,
        accumulate=accumulate,
        rows=hardware.flight_rows,
        steps=hardware.crash_steps,
    )
    bundles = Bundles(context, train, batch_size, accumulate, hardware.crash_steps, settle)
    failures = NotFinite(context.name, context.console, stop=on_not_finite == "stop")
    own.append(FlightRecorder(settings, failures, bundles, context.console, waits))
    if hardware.profile:
        own.append(StepProfiler(context.name, context.folder, hardware.profile, steps, context.console))
    return own
