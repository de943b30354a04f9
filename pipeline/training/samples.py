"""Motions drawn while a training goes on (`train.sample_every`), by a process of its own beside it."""

from __future__ import annotations

import subprocess
import sys

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.stage import GENERATOR, StageContext, stage_kind
from motionloom.pipeline.store.files import open_own
from motionloom.pipeline.store.run_folder import owner_of
from motionloom.pipeline.store.training_log import SAMPLES, optional

_PROGRAM = "motionloom.pipeline.runs.samples"
"""On a floor above, which only the new process needs."""


class SampleProcess:
    """Starts the drawing, one process at a time. The training never waits for it, nor ends with it."""

    def __init__(self, context: StageContext, kind: str, every: int) -> None:
        """`every` is in steps; 0, or a kind that makes no motion, draws nothing."""
        makes = every and GENERATOR in stage_kind(kind, context.name).gives(context.config)
        self.context, self.every = context, every if makes else 0
        self._process: subprocess.Popen[bytes] | None = None
        self._failed = False

    def saved(self, step: int) -> None:
        """The checkpoint of a step is on disk: draw with it, where it is time and no drawing goes on."""
        code = 0 if self._process is None else self._process.poll()
        if code is None or not self.every or step % self.every:
            return
        log, failed, self._failed = self.context.folder / SAMPLES / "log.txt", self._failed, code != 0
        with optional(f"{self.context.name}: what train.sample_every draws", self.context.console):
            if code and not failed:
                raise UserError(f"the last process failed, {log} says why")
            run = owner_of(self.context.folder)
            with open_own(log, "wb") as file:
                # A session of its own: what signals the training's group does not reach it.
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", _PROGRAM, str(run), self.context.name],
                    stdin=subprocess.DEVNULL,
                    stdout=file,
                    stderr=file,
                    start_new_session=True,
                )
