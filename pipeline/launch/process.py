"""This process among those of a run: its rank, and how it ends."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

from motionloom.datasets.base.errors import UserError

SAVED = 75
"""Exit code of a run that a signal has ended with all its steps saved, whatever signal it was.

The system's number for "try again later" (`EX_TEMPFAIL`): the same command goes on.
"""


_PARENT_POLL = 2.0
"""Seconds between two looks of a loader worker at whether its parent is still there."""

LOST = 76
"""Exit code of a process that ends because another one of its run has."""


_LOOK = 1.0
"""Seconds to wait for the exit code of a process: its connections close a moment before it has one."""

_ANSWER = 5.0
"""Seconds for which ranks are asked who is still there: a step of training may end before one hears it."""
started: list[subprocess.Popen[bytes]] = []
"""Processes of ranks 1, 2, ... of this machine that this one has started: none under torchrun or srun."""


class TeamError(Exception):
    """Another process of this run has stopped; the message says which, how, and what to do."""

    @property
    def exit_code(self) -> int:
        return _joint_exit(LOST)

    @classmethod
    def lost(cls, folder: Path | None = None) -> TeamError:
        """The error where a connection broke; processes that hung have left their stacks in `folder`."""
        stacks = sorted(folder.glob("stalled_rank_*.txt")) if folder else []
        traces = "".join(f"; {path} says where it hung" for path in stacks if path.stat().st_size)
        return cls(f"{_who_ended()}{traces}; the same command goes on from the newest checkpoint")


def _who_ended() -> str:
    """Name the process that ended first and how, as far as this one can know."""
    end = time.monotonic() + _LOOK
    while started and time.monotonic() < end:
        for number, process in enumerate(started, start=1):
            code = process.poll()
            if code not in (None, 0, LOST):  # those have ended because of another
                return f"process {number} of this machine (pid {process.pid}) {_how_ended(code or 0)}"
        time.sleep(0.02)
    return f"{_who_is_silent()}; its own log may say why"


members: list[str] = []
"""Where each rank of this process's team is: its machine and number there."""


def _who_is_silent() -> str:
    """Name the ranks that do not answer in the store by which the team has met.

    Each that lost a connection answers for `_ANSWER` seconds; one that is dead or hangs does not.
    """
    missing = [*range(len(members))]
    if members:
        ask = threading.Thread(target=_call_roll, args=(missing,), daemon=True)
        ask.start()
        ask.join(2 * _ANSWER)  # a store whose process is stopped does not answer at all
    silent = ", ".join(f"rank {rank} ({members[rank]})" for rank in missing)
    return f"{silent or 'another process of this run'} has stopped or hangs"


def _call_roll(missing: list[int]) -> None:
    """Answer, and take those who answer off the list; rank 0 alone stays where its store has gone."""
    import torch.distributed as dist

    others = [rank for rank in missing if rank != dist.get_rank()]
    missing[:] = [0]
    store = dist.distributed_c10d._get_default_store()
    end = time.monotonic() + _ANSWER
    with suppress(RuntimeError):
        store.set(f"lost/{dist.get_rank()}", "")
        while others and time.monotonic() < end:
            time.sleep(0.1)
            others = [rank for rank in others if not store.check([f"lost/{rank}"])]
        missing[:] = others


def _how_ended(code: int) -> str:
    if code > 0:
        return f"ended with exit code {code}; its lines stand above"
    memory = ", as the system does where memory runs out" if -code == signal.SIGKILL else ""
    return f"was ended by signal {-code} ({signal.Signals(-code).name}{memory})"


class Interrupted(BaseException):
    """A signal came while a stage was trained: its last step is saved, and the same command goes on there.

    No `Exception`, as Ctrl-C is none: nothing has failed.
    """

    def __init__(self, stage: str, step: int, steps: int, signal: str) -> None:
        super().__init__(f"{signal}: {stage} is saved at step {step} of {steps}")
        self.stage = stage
        self.step = step
        self.steps = steps
        self.signal = signal

    @property
    def exit_code(self) -> int:
        return _joint_exit(SAVED)


class JointError(UserError):
    """A user's mistake that all processes of a run have found together: the lead alone says it."""

    @property
    def exit_code(self) -> int:
        return _joint_exit(2)


def process_rank() -> int:
    """0 in the process that leads: the global rank as torchrun or SLURM states it, else as Lightning does.

    Lightning's own launcher states the rank within a node only, so on other nodes the number is merely not 0.
    """
    if "RANK" in os.environ:
        return int(os.environ["RANK"])
    if srun_tasks() > 1:
        return int(os.environ["SLURM_PROCID"])
    return int(os.environ.get("NODE_RANK", 0)) + int(os.environ.get("LOCAL_RANK", 0))


def _joint_exit(code: int) -> int:
    """The code; 0 in processes of Lightning's launcher, which kills the lead where one ends otherwise, while
    it may write a checkpoint still."""
    return 0 if _started_by_lead() else code


def _started_by_lead() -> bool:
    return "RANK" not in os.environ and srun_tasks() == 1 and int(os.environ.get("LOCAL_RANK", 0)) > 0


def srun_tasks() -> int:
    """Processes that srun started together with this one; 1 without srun.

    A batch script, or a shell that salloc gives, knows the job's SLURM_NTASKS too and is one process all the
    same: srun alone counts the tasks of a step.
    """
    if "SLURM_PROCID" not in os.environ:
        return 1
    if "SLURM_STEP_NUM_TASKS" in os.environ:
        return int(os.environ["SLURM_STEP_NUM_TASKS"])
    # No script has another number than 0.
    return int(os.environ.get("SLURM_NTASKS", 1)) if int(os.environ["SLURM_PROCID"]) else 1


_NODE = ("NODE_RANK", "JOB_COMPLETION_INDEX", "SKYPILOT_NODE_RANK")
"""Which machine this is: as anybody says it, a Kubernetes Indexed Job (a JobSet, too), SkyPilot."""


def take_place(nodes: int) -> None:
    """Take up which of `nodes` machines this is and where they meet, unless torchrun or srun has said so."""
    env = os.environ
    if nodes == 1 or "RANK" in env or srun_tasks() > 1:
        return
    for name in (name for name in _NODE if name in env):
        env.setdefault("NODE_RANK", env[name])
    for address in env.get("SKYPILOT_NODE_IPS", "").split()[:1]:
        env.setdefault("MASTER_ADDR", address)
    env.setdefault("MASTER_PORT", "29500")


def beside() -> int:
    """Processes that torchrun or srun started together, this one among them: all of them meet."""
    return int(os.environ["WORLD_SIZE"]) if "RANK" in os.environ else srun_tasks()


def local_rank() -> int:
    """This process among those on its machine, as torchrun and Lightning or else SLURM state it."""
    return int(os.environ.get("LOCAL_RANK", os.environ.get("SLURM_LOCALID", 0)))


def leave(code: int) -> NoReturn:
    """End this process; one that trained with others ends without destructors.

    torch's gloo group may be destroyed while the interpreter lock is held and then waits for a thread that
    wants that lock: the process would hang after its work is done. Every file is written by then.
    """
    torch = sys.modules.get("torch")
    if torch is not None and torch.distributed.is_available() and torch.distributed.is_initialized():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    gc.freeze()  # nothing is left to collect; looking through torch once more takes half a second
    sys.exit(code)


def end_with_parent(parent: int, _worker: int = 0) -> None:
    """Have a loader worker end when its process, `parent`, has gone: also where it hangs in a read, or was
    still starting.

    torch's own look at the parent is between two batches only, and takes whoever is the parent by then.
    """
    threading.Thread(target=_watch_parent, args=(parent,), daemon=True).start()


def _watch_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_PARENT_POLL)
    os._exit(1)
