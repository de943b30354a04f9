"""A batch script as bash runs it: it ends as its command, and passes on what SLURM sends."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import time
from pathlib import Path, PurePosixPath
from typing import Any

import pytest

from motionloom.pipeline.cluster import slurm_run
from motionloom.pipeline.cluster.plan import make_launch_plan
from motionloom.pipeline.launch.options import SlurmOptions
from motionloom.pipeline.runs.recipe import load_recipe


def script(folder: Path) -> str:
    """Of the first group of a launch, whose command is one process."""
    options = SlurmOptions()
    plan = make_launch_plan(
        load_recipe("humantomato-tiny"),
        options,
        given="humantomato-tiny",
        overrides=(),
        out=PurePosixPath(folder / "run"),
        nodes=1,
        gpus_per_node=0,
    )
    return slurm_run.slurm_scripts(plan, options, folder, folder)[0].text


def run_script(text: str, folder: Path, scontrol: str) -> subprocess.Popen[str]:
    """The script as SLURM would start it, with a `scontrol` of ours."""
    program = folder / "scontrol"
    program.write_text(f"#!/bin/sh\n{scontrol}\n")
    program.chmod(0o755)
    path = folder / "job.sbatch"
    path.write_text(text)
    count = os.environ.get("SLURM_RESTART_COUNT", "0")
    env = {"PATH": f"{folder}:{os.environ['PATH']}", "SLURM_JOB_ID": "7", "SLURM_RESTART_COUNT": count}
    return subprocess.Popen(["bash", str(path)], env=env, text=True, cwd=folder, start_new_session=True)


@pytest.mark.parametrize("code", [0, 3])
def test_a_job_ends_as_its_command(tmp_path: Path, code: int, monkeypatch: Any) -> None:
    monkeypatch.setattr(slurm_run, "PROGRAM", ("sh", "-c", f"exit {code}", "motionloom"))
    assert run_script(script(tmp_path), tmp_path, "exit 1").wait(30) == code


@pytest.mark.parametrize(
    ("answer", "count", "scontrol", "code"),
    [
        ("exit 75", 0, "exit 0", None),  # a training that saves
        ("", 0, "exit 0", None),  # a command that the signal ends
        ("exit 75", 0, "exit 1", 75),  # SLURM refuses
        ("exit 3", 0, "exit 0", 3),  # it has failed meanwhile
        ("exit 0", 0, "exit 0", 0),  # it was done
        ("exit 75", 100, "exit 0", 4),  # often enough: it may still finish
    ],
)
def test_a_warning_reaches_the_command(
    tmp_path: Path,
    monkeypatch: Any,
    answer: str,
    count: int,
    scontrol: str,
    code: int | None,
) -> None:
    """Then its job is queued again, where it has ended as one that is to go on."""
    trap = f"trap {shlex.quote(answer)} USR1; " if answer else ""
    waiting = f"{trap}touch started; while [ ! -e go ]; do sleep 0.02; done; exit 4"
    monkeypatch.setattr(slurm_run, "PROGRAM", ("sh", "-c", waiting, "motionloom"))
    monkeypatch.setenv("SLURM_RESTART_COUNT", str(count))
    job = run_script(script(tmp_path), tmp_path, f'echo "$@" > asked; {scontrol}')
    try:
        wait_until(lambda: (tmp_path / "started").exists())
        job.send_signal(signal.SIGUSR1)
        if code == 4:
            (tmp_path / "go").touch()
        if code is not None:
            assert job.wait(30) == code
        if code in (None, 75):
            wait_until(lambda: (tmp_path / "asked").exists() and (tmp_path / "asked").read_text() != "")
            assert (tmp_path / "asked").read_text() == "requeue 7\n"
        else:
            assert not (tmp_path / "asked").exists()
        if code is None:
            time.sleep(0.1)
            assert job.poll() is None  # it waits for SLURM to end it
    finally:
        if job.poll() is None:
            os.killpg(job.pid, signal.SIGKILL)
        job.wait(30)


def test_the_end_of_a_job_reaches_the_command(tmp_path: Path, monkeypatch: Any) -> None:
    """A preemption: SLURM queues the job again by itself."""
    waiting = "trap 'touch saved; exit 75' TERM; touch started; while :; do sleep 0.02; done"
    monkeypatch.setattr(slurm_run, "PROGRAM", ("sh", "-c", waiting, "motionloom"))
    job = run_script(script(tmp_path), tmp_path, 'echo "$@" > asked')
    wait_until(lambda: (tmp_path / "started").exists())
    job.send_signal(signal.SIGTERM)
    assert job.wait(30) == 75
    assert (tmp_path / "saved").exists() and not (tmp_path / "asked").exists()


def wait_until(ready: Any) -> None:
    deadline = time.monotonic() + 30
    while not ready():
        assert time.monotonic() < deadline
        time.sleep(0.02)
