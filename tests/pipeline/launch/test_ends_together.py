"""One process of a run dies, stops or hangs: the launcher, or a time-out, ends them all."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from watched_training import Jobs, end_of, is_gone, pid_of, until, wait_for_step

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks up processes in /proc"),
]
TORCHRUN = (sys.executable, "-P", "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")


@pytest.fixture
def jobs() -> Iterator[Jobs]:
    """Starts jobs of two processes; nothing of them outlives the test."""
    started = Jobs()
    yield started
    started.end()


@pytest.mark.parametrize("rank", [0, 1])
def test_the_others_end_when_one_dies(jobs: Jobs, tmp_path: Path, rank: int) -> None:
    """Processes of Lightning's launcher, which `motionloom run` uses on one machine."""
    job = jobs.start(tmp_path, "goes", (sys.executable, "-P"))
    wait_for_step(tmp_path, 5)
    pids = [pid_of(tmp_path, one) for one in range(2)]
    os.kill(pids[rank], signal.SIGKILL)
    said = end_of(job, pids)
    who = f"process 1 of this machine (pid {pids[1]})" if rank else "process 0, which started this one, has"
    assert who in said and ("SIGKILL" in said) == bool(rank) and ".cc:" not in said


@pytest.mark.parametrize("how", ["stops", "hangs"])
def test_one_that_makes_no_progress_ends_the_job(jobs: Jobs, tmp_path: Path, how: str) -> None:
    """Under torchrun: who can end itself leaves the stacks of its threads, the agent ends who cannot."""
    job = jobs.start(tmp_path, "hangs" if how == "hangs" else "goes", TORCHRUN)
    if how == "stops":
        wait_for_step(tmp_path, 5)
    until(lambda: all((tmp_path / f"{one}.pid").exists() for one in range(2)), "not begun", 300)
    pids = [pid_of(tmp_path, one) for one in range(2)]
    if how == "stops":
        os.kill(pids[1], signal.SIGSTOP)
    end_of(job, pids)
    found = {path.name: path.read_text() for path in tmp_path.rglob("stalled_rank_*")}
    assert found and any("__getitem__" in text for text in found.values()) is (how == "hangs")


def test_a_hanging_loader_worker_ends_with_its_process() -> None:
    hangs = (
        "import os, time; from motionloom.pipeline.launch.process import end_with_parent; "
        "end_with_parent(os.getppid()); time.sleep(600)"
    )
    starts = (
        "import subprocess, sys, time; print(subprocess.Popen(sys.argv[1:]).pid, flush=True); time.sleep(600)"
    )
    words = [sys.executable, "-c", starts, sys.executable, "-P", "-c", hangs]
    parent = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    until(lambda: len(list(Path(f"/proc/{pid}/task").iterdir())) > 1, "no thread looks")
    parent.kill()
    parent.wait(timeout=60)
    until(lambda: is_gone(pid), "the worker goes on")
