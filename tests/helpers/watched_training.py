"""Jobs of two processes in which one dies or stalls, and how they end.

    python tests/helpers/watched_training.py OUT goes|hangs|units [NODES]

is one process, as Lightning's launcher, torchrun or srun starts it: it trains until something ends it
(`goes`), `hangs` in the read of batch 33 if its rank is 1, or makes units of a divided work, of which rank
1's last hangs.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from motionloom.pipeline.launch import ending

STALL = 15
"""Seconds; longer than a busy machine takes over one step of so small a training."""


def until(true: Callable[[], bool], what: str, seconds: float = 60) -> None:
    """Wait for it."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, what
        time.sleep(0.02)


def is_gone(pid: int) -> bool:
    """Whether a process has ended."""
    return not ending._stat(pid) or ending._stat(pid)[0] == "Z"


def pid_of(out: Path, rank: int) -> int:
    """Of a rank that has begun."""
    return int((out / f"{rank}.pid").read_text())


def wait_for_step(out: Path, step: int, seconds: float = 300) -> None:
    """Until a checkpoint of that step or a later one is there, and the other processes know of it."""
    reached = lambda: any(int(p.stem[5:]) >= step for p in out.glob("checkpoints/s*.ckpt"))  # noqa: E731
    until(reached, "no steps", seconds)
    time.sleep(3)  # words of what a process does come every second


def descendants(*jobs: subprocess.Popen[str]) -> list[int]:
    """The processes of jobs."""
    return [pid for job in jobs for pid in (job.pid, *ending._descendants(job.pid))]


class Jobs:
    """Starts jobs; nothing of them outlives the test."""

    def __init__(self) -> None:
        self.started: list[subprocess.Popen[str]] = []

    def start(
        self, out: Path, how: str, launcher: Sequence[str], *more: str, **variables: str
    ) -> subprocess.Popen[str]:
        """Have `launcher` start this file."""
        path = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(Path(__file__).parent)]))
        self.started.append(
            subprocess.Popen(
                [*launcher, __file__, str(out), how, *more],
                env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", **variables},
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
            )
        )
        return self.started[-1]

    def end(self) -> None:
        """Kill what is left."""
        for job in self.started:
            with suppress(ProcessLookupError):
                os.killpg(job.pid, signal.SIGKILL)


def end_of(jobs: Iterable[subprocess.Popen[str]], pids: Sequence[int]) -> list[str]:
    """What the jobs said; they end by themselves, and no process that they started is left."""
    ended = []
    for job in jobs:
        said: str = job.communicate(timeout=200)[0]
        ended.append(said)
        assert job.returncode != 0, said
    left: Any = lambda: [pid for pid in pids if not is_gone(pid)]  # noqa: E731
    until(lambda: not left(), f"left behind: {left()}\n{ended}", 40)
    return ended


def main(out: Path, how: str, nodes: int) -> None:
    """One rank."""
    from rich.console import Console
    from tiny_players import Duel, Vectors, context

    from motionloom.pipeline.launch import watch
    from motionloom.pipeline.launch.team import Team
    from motionloom.pipeline.stages.train_config import TrainConfig
    from motionloom.pipeline.stages.training import fit

    given = {"devices": 2 // nodes, "nodes": nodes, "stall_seconds": STALL}
    stage = context(out, Console(quiet=True), **given)
    team = Team.start(stage.hardware)
    (out / f"{team.rank}.pid").write_text(str(os.getpid()))
    if how == "units":
        mine = watch.current()
        assert mine is not None
        mine.enter_stage("shared", out, "before its first step")
        divide(out, team)
        return
    at = 33 if team.rank == 1 and how == "hangs" else None
    config = TrainConfig(steps=10**6, batch_size=8, validate_every=0, checkpoint_every=5)
    duel = Duel(seed=3, max_steps=config.steps)
    fit(stage, duel, config, lambda *place: Vectors(*place, hangs_at=at), None, 0.0)


def divide(out: Path, team: Any) -> None:
    """Units 1 and 3 are rank 1's; the last hangs."""
    import numpy as np

    from motionloom.pipeline.contract.units import Units

    def result(index: int) -> dict[str, Any]:
        time.sleep(0.2 if index < 3 else 3600)
        return {"x": np.zeros(1)}

    Units(out / "work", team.rank, team.world).make("train", 4, result)
    team.meet()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]) if len(sys.argv) > 3 else 1)
