"""One process of a run dies or stalls: all end, one sentence says which one, nothing is left behind.

What is judged, on made-up figures; the connections, between threads of this process; and whole trainings,
whose processes are those of `watched_training.py`.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from watched_training import Jobs, descendants, end_of, is_gone, pid_of, until, wait_for_step

from motionloom.pipeline.contract.units import Units
from motionloom.pipeline.launch import ending
from motionloom.pipeline.launch.beats import Beat, Peer, judge
from motionloom.pipeline.launch.lines import Line
from motionloom.pipeline.launch.watch import ENDED, Watch

linux = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks up processes in /proc")


def peer(
    rank: int, *, idle: float = 0, silent: float = 0, expected: bool = True, count: int = 0, **more: Any
) -> Peer:
    beat = Beat(rank, "node", 100 + rank, "7", "gpt", "computing a step", 42, count, idle, expected)
    return Peer(beat, silent, **{"known": True, **more})


def test_nobody_is_blamed_while_all_go_on() -> None:
    assert judge([peer(0), peer(1, idle=59), peer(2, silent=59)], 60) is None
    assert judge([peer(0, idle=1e6, expected=False), peer(1, idle=1e6, expected=False)], 60) is None
    assert judge([peer(0, idle=1e6), peer(1, silent=1e6)], 0) is None, "0 turns it off"
    assert judge([peer(0), peer(1, gone=True, done=True), peer(2, gone=True, known=False)], 60) is None


def test_a_closed_connection_is_a_death_whatever_the_setting() -> None:
    verdict = judge([peer(0), peer(3, gone=True)], 0)
    assert verdict is not None and not verdict.stalled and verdict.rank == 3
    assert verdict.sentence.startswith(
        "rank 3 on node (process 103) has died; it was at stage gpt, step 42, computing a step."
    )


def test_the_dead_and_not_their_victims_are_blamed() -> None:
    ended = peer(1, gone=True, code=1)
    verdict = judge([peer(0), ended, peer(2, gone=True)], 60)
    assert verdict is not None and verdict.rank == 2
    verdict = judge([peer(0), ended], 60)
    assert verdict is not None and "rank 1" in verdict.sentence and "exit code 1" in verdict.sentence


def test_units_of_a_divided_work_may_take_what_units_take() -> None:
    """Ten times the longest so far of the same work, by whoever made it; nobody knows before."""
    own, other = peer(0, idle=900), peer(1, expected=False)
    own.beat.work, other.beat.work = "generated", "reconstructed"
    other.beat.longest = 1.0
    assert judge([own, other], 60) is None, "units of another work say nothing"
    other.beat.work, other.beat.longest = "generated", 91.0
    assert judge([own, other], 60) is None
    other.beat.longest = 89.0
    verdict = judge([own, other], 60)
    assert verdict is not None and verdict.stalled and verdict.rank == 0
    other.beat.longest, own.beat.idle = 0.1, 59.0
    assert judge([own, other], 60) is None
    own.beat.idle = 61.0
    assert judge([own, other], 60) is not None


def test_a_process_says_which_unit_it_makes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mine, seen = Watch(0, 60), []
    monkeypatch.setattr("motionloom.pipeline.launch.watch._current", mine)
    mine.enter_stage("tokens", tmp_path, "before its first step")

    def result(index: int) -> dict[str, Any]:
        seen.append((mine.beat.place(), mine.beat.expected, mine.beat.work, mine.beat.longest > 0))
        return {"x": np.zeros(1)}

    units = Units(tmp_path, rank=1, world=2)
    units.make("train", 4, result)
    assert seen == [
        ("stage tokens, making unit 2 of 4 (train)", True, "train", False),
        ("stage tokens, making unit 4 of 4 (train)", True, "train", True),
    ]
    assert not mine.beat.expected and mine.beat.longest > 0
    units.make("val", 2, result)
    assert seen[2:] == [("stage tokens, making unit 2 of 2 (val)", True, "val", False)]


@linux
@pytest.mark.slow
def test_a_unit_that_hangs_ends_the_stage(jobs: Jobs, tmp_path: Path) -> None:
    """Work that processes divide, where nobody waits for another one."""
    job = jobs.start(tmp_path, "units", (sys.executable, "-P"))
    until(lambda: len([*tmp_path.glob("work/train-*.npz")]) == 3, "no units", 250)
    said = end_of([job], descendants(job))[0]
    assert said.count("has stalled: no progress") == 1 and "error: rank 1 on" in said, said
    assert "stage shared, making unit 4 of 4 (train)" in said
    assert "in result" in (tmp_path / "flight/stacks_rank_1.txt").read_text()


def test_the_one_that_stopped_first_is_blamed_and_not_those_who_wait_for_it() -> None:
    verdict = judge([peer(0, idle=64, count=9), peer(1, idle=63, count=8), peer(2, idle=62, count=8)], 60)
    assert verdict is not None and verdict.stalled and verdict.rank == 1 and not verdict.mute
    assert "no progress for 63 s (hardware.stall_seconds)" in verdict.sentence
    # A stopped process says nothing; the others say that they wait.
    waiting = [peer(0, idle=61), peer(1, silent=59.5), peer(2, idle=62)]
    assert judge(waiting, 60) is None
    waiting[1].silent = 61
    verdict = judge(waiting, 60)
    assert (
        verdict is not None
        and verdict.rank == 1
        and verdict.mute
        and "has not answered for 61 s" in verdict.sentence
    )


class Ends:
    """Notes how a process would have ended."""

    def __init__(self) -> None:
        self.code: int | None = None

    def __call__(self, code: int) -> None:
        self.code = code


@pytest.fixture
def trio(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[tuple[Watch, Ends]]]:
    """Three ranks in threads; they end nothing."""
    monkeypatch.setattr("motionloom.pipeline.launch.watch.kill_children", lambda: None)
    made: list[tuple[Watch, Ends]] = []
    for rank in range(3):
        ends = Ends()
        watch = Watch(rank, 0, ends)
        watch.grace = 0.05
        made.append((watch, ends))
    address = made[0][0].listen("127.0.0.1")
    for watch, _ in made[1:]:
        watch.connect(*address)
    for watch, _ in made:
        watch.start()
    until(lambda: len(made[0][0]._peers) == 2 and all(w._peers[0].known for w, _ in made[1:]), "no contact")
    yield made
    for watch, _ in made:
        watch.stop()


def die(watch: Watch) -> None:
    """As the system does: connections are closed without a word."""
    watch._over.set()
    assert watch._thread is not None
    watch._thread.join()
    for line in watch._lines.values():
        line.close()


def test_all_end_when_one_dies(trio: list[tuple[Watch, Ends]], capfd: pytest.CaptureFixture[str]) -> None:
    lead, other = trio[0][0], trio[1]
    trio[2][0].enter_stage("gpt", Path("gpt"), "waiting")
    trio[2][0].progress("computing a step", 5)
    until(lambda: lead._peers[2].beat.step == 5, "the lead does not hear where rank 2 is")
    die(trio[2][0])
    until(lambda: trio[0][1].code is not None and other[1].code is not None, "they go on")
    assert trio[0][1].code == other[1].code == ENDED
    said = capfd.readouterr().err
    assert said.count("has died") == 1 and "rank 2" in said and "step 5, computing a step" in said
    explained = other[0].explanation()
    assert explained is not None and explained == lead.explanation()


def test_the_others_end_when_the_lead_dies(
    trio: list[tuple[Watch, Ends]], capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LOCAL_RANK", "1")
    die(trio[0][0])
    until(lambda: all(ends.code == ENDED for _, ends in trio[1:]), "they go on")
    assert "rank 0" in capfd.readouterr().err


def test_goodbye_is_no_death(trio: list[tuple[Watch, Ends]]) -> None:
    trio[2][0].stop(75)
    until(lambda: trio[0][0]._peers[2].done and trio[0][0]._peers[2].gone, "no goodbye")
    trio[1][0].stop(3)
    until(lambda: trio[0][1].code is not None, "an error of rank 1 ends nobody")
    assert "rank 1" in str(trio[0][0].explanation()) and "exit code 3" in str(trio[0][0].explanation())


def test_strangers_are_not_listened_to(trio: list[tuple[Watch, Ends]]) -> None:
    lead = trio[0][0]
    assert lead._listener is not None
    for word in (b'{"token": "guess", "rank": 1}\n', b"\xff\n", b"x" * 200_000):
        with socket.create_connection(lead._listener.getsockname(), timeout=30) as stranger:
            stranger.sendall(word)
            stranger.settimeout(30)
            with contextlib.suppress(ConnectionError):
                assert stranger.recv(1) == b"", "answered"
    assert set(lead._peers) == {1, 2} and lead.verdict is None


def test_no_contact_is_no_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    watch = Watch(1, 5)
    with pytest.warns(UserWarning, match="rank 1 cannot reach rank 0"):
        watch.connect("127.0.0.1", port, "x")
    assert watch.explanation() is None


def test_a_message_of_many_pieces_and_rubbish() -> None:
    left, right = socket.socketpair()
    line = Line(right)
    left.sendall(b'{"a": 1}\n{"b"')
    assert line.receive() == [{"a": 1}] and not line.closed
    left.sendall(b": 2}\n")
    left.close()
    assert line.receive() == [{"b": 2}] and line.closed
    for rubbish in (b"rubbish\n", b"[1]\n", b"\xff\n"):
        left, right = socket.socketpair()
        line = Line(right)
        left.sendall(b'{"a": 1}\n' + rubbish + b'{"a": 2}\n')
        assert line.receive() == [{"a": 1}] and line.closed


@linux
def test_only_the_very_process_is_killed() -> None:
    sleeper = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    try:
        birth = ending.birth_of(sleeper.pid)
        assert birth and sleeper.pid in ending._descendants(os.getpid())
        os.kill(sleeper.pid, signal.SIGSTOP)
        ending.kill_stopped(sleeper.pid, str(int(birth) + 1))
        ending.kill_stopped(sleeper.pid, "")
        assert sleeper.poll() is None
        ending.kill_stopped(sleeper.pid, birth)
        assert sleeper.wait(timeout=60) == -signal.SIGKILL
    finally:
        sleeper.kill()


CHILD = "import os, sys, time; from motionloom.pipeline.launch.ending import end_with_parent; "
PARENT = (
    "import subprocess, sys, time; print(subprocess.Popen(sys.argv[1:]).pid, flush=True); time.sleep(600)"
)


@linux
@pytest.mark.parametrize("starts", [False, True])
def test_a_hanging_loader_worker_ends_with_its_process(starts: bool) -> None:
    """Also one that had not finished to start when the process died."""
    begin = "time.sleep(3); " if starts else ""
    child = f"parent = os.getppid(); {begin}{CHILD}end_with_parent(parent); time.sleep(600)"
    words = [sys.executable, "-c", PARENT, sys.executable, "-P", "-c", f"import os, time; {child}"]
    parent = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    try:
        if not starts:
            until(lambda: len(list(Path(f"/proc/{pid}/task").iterdir())) > 1, "no thread looks")
        else:
            time.sleep(1)
        parent.kill()
        parent.wait(timeout=60)
        until(lambda: is_gone(pid), "the worker goes on")
    finally:
        parent.kill()
        if not is_gone(pid):
            os.kill(pid, signal.SIGKILL)


# Whole trainings.


@linux
@pytest.mark.slow
@pytest.mark.parametrize("rank", [0, 1])
def test_a_stopped_rank_ends_the_job(jobs: Jobs, tmp_path: Path, rank: int) -> None:
    job = jobs.start(tmp_path, "goes", (sys.executable, "-P"))
    wait_for_step(tmp_path, 30)
    pids = descendants(job)
    os.kill(pid_of(tmp_path, rank), signal.SIGSTOP)
    said = end_of([job], pids)[0]
    assert said.count("has stalled: it has not answered") == 1 and f"error: rank {rank} on" in said, said
    assert "it was at stage duel, step" in said
    assert "training.py" in (tmp_path / f"flight/stacks_rank_{1 - rank}.txt").read_text()


@linux
@pytest.mark.slow
def test_a_read_that_hangs_ends_the_job_under_torchrun(jobs: Jobs, tmp_path: Path) -> None:
    launch = ("-P", "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
    job = jobs.start(tmp_path, "hangs", (sys.executable, *launch))
    pids: set[int] = set()

    def over() -> bool:
        pids.update([job.pid, *ending._descendants(job.pid)])
        return job.poll() is not None

    until(over, "the job goes on", 250)
    said = end_of([job], sorted(pids))[0]
    assert said.count("has stalled: no progress") == 1 and "error: rank 1 on" in said, said
    assert re.search(r"stage duel, step (32|33), waiting for a batch", said), said  # Lightning reads ahead
    stacks = [(tmp_path / f"flight/stacks_rank_{rank}.txt").read_text() for rank in range(2)]
    assert "in __getitem__" in stacks[1] and "in __getitem__" not in stacks[0]
