"""Jobs of two processes in which one dies, stops or hangs, and how they end.

    python tests/helpers/watched_training.py OUT goes|hangs [NODES]

is one process, as Lightning's launcher, torchrun or srun starts it: it trains until something ends it
(`goes`), or `hangs` in the read of batch 33 if its rank is 1.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path

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
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state == "Z"


def pid_of(out: Path, rank: int) -> int:
    """Of a rank that has begun."""
    return int((out / f"{rank}.pid").read_text())


def wait_for_step(out: Path, step: int, seconds: float = 300) -> None:
    """Until a checkpoint of that step or a later one is there."""
    reached = lambda: any(int(p.stem[5:]) >= step for p in out.glob("checkpoints/s*.ckpt"))  # noqa: E731
    until(reached, "no steps", seconds)


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


def end_of(job: subprocess.Popen[str], pids: Iterable[int]) -> str:
    """What the job said; it ends by itself with a code, and none of its processes is left."""
    said: str = job.communicate(timeout=200)[0]
    assert job.returncode != 0, said
    for pid in pids:
        until(lambda pid=pid: is_gone(pid), f"left behind: {pid}\n{said}", 40)  # type: ignore[misc]
    return said


def main(out: Path, how: str, nodes: int) -> None:
    """One rank."""
    from rich.console import Console
    from tiny_adversaries import Duel, Vectors, context

    from motionloom.pipeline.launch.process import leave
    from motionloom.pipeline.launch.team import Team
    from motionloom.pipeline.training.config import TrainConfig
    from motionloom.pipeline.training.trainer import fit

    given = {"devices": 2 // nodes, "nodes": nodes, "stall_seconds": STALL}
    stage = context(out, Console(quiet=True), **given)
    team = Team.start(stage.hardware)
    (out / f"{team.rank}.pid").write_text(str(os.getpid()))
    at = 33 if team.rank == 1 and how == "hangs" else None
    config = TrainConfig(steps=10**6, batch_size=8, validate_every=0, checkpoint_every=5)
    duel = Duel(seed=3, max_steps=config.steps)
    try:
        fit(stage, duel, config, lambda *place: Vectors(*place, hangs_at=at), None)
    except Exception:  # the command line does the same: a process group may hang as it is destroyed
        traceback.print_exc()
        leave(1)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]) if len(sys.argv) > 3 else 1)
