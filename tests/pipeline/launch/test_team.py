"""How many processes a machine's settings mean; a launcher and a recipe that disagree are refused, before two
processes train into the same files.

Requeueing under SLURM is left to the run itself, which resumes whatever happens.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.fabric.strategies.launchers import subprocess_script
from rich.console import Console
from watched_training import Jobs, end_of, is_gone, pid_of, until, wait_for_step

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.process import LOST, TeamError, process_rank, srun_tasks
from motionloom.pipeline.launch.team import Team, environment, give_time
from motionloom.pipeline.runs.api import run_recipe

RECIPE = """
name: x
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data: {kind: synth, clips: 16}
  stats: {kind: stats}
  tokenizer:
    kind: vq
    net: {width: 8, depth: 1, code_dim: 8, num_codes: 8}
    train: {steps: 2, batch_size: 4, validate_every: 0}
"""


LAUNCHED = {"RANK", "WORLD_SIZE", "NODE_RANK", "LOCAL_RANK", "LOCAL_WORLD_SIZE"}


@pytest.fixture(autouse=True)
def no_launcher(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [*os.environ]:
        if name.startswith("SLURM_") or name in LAUNCHED:
            monkeypatch.delenv(name)


Srun = Callable[..., dict[str, str]]


@pytest.fixture
def srun(monkeypatch: pytest.MonkeyPatch) -> Srun:
    """What `srun --nodes N --ntasks-per-node K` says to one of its tasks."""

    def go(per_node: int, nodes: int = 1, rank: int = 0, **more: str) -> dict[str, str]:
        tasks = str(per_node * nodes)
        facts = {
            "SLURM_JOB_ID": "7",
            "SLURM_JOB_NAME": "train",
            "SLURM_NTASKS": tasks,
            "SLURM_STEP_NUM_TASKS": tasks,
            "SLURM_NTASKS_PER_NODE": str(per_node),
            "SLURM_NNODES": str(nodes),
            "SLURM_PROCID": str(rank),
            "SLURM_LOCALID": str(rank % per_node),
            "SLURM_NODEID": str(rank // per_node),
            **more,
        }
        for name, value in facts.items():
            monkeypatch.setenv(name, value)
        return facts

    return go


def cpu(devices: int = 0, nodes: int = 1) -> Hardware:
    return Hardware(accelerator="cpu", devices=devices, nodes=nodes)


def test_the_lead_has_time_to_finish_its_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lightning's observer kills it else within five seconds of another process's end."""
    kept: list[Any] = []
    monkeypatch.setattr(threading.Thread, "start", lambda self: kept.append(self))
    subprocess_script._launch_process_observer([])
    monkeypatch.setattr(threading, "enumerate", lambda: kept)
    give_time()
    assert [one._sleep_period for one in kept] == [60]


@pytest.mark.parametrize("rank", [0, 1])
def test_tasks_of_srun_do_not_train_alone(srun: Srun, rank: int) -> None:
    srun(2, rank=rank)
    assert process_rank() == rank
    with pytest.raises(UserError, match=r"started 2 .*1 node.*1 on 1"):
        Team.start(cpu())
    for per_node, nodes, devices in ((4, 1, 2), (1, 2, 2), (2, 2, 4)):
        srun(per_node, nodes)
        with pytest.raises(UserError, match=r"hardware\.devices .*hardware\.nodes"):
            Team.start(cpu(devices))


def test_srun_must_say_how_many_on_a_node(srun: Srun, monkeypatch: pytest.MonkeyPatch) -> None:
    srun(2)
    monkeypatch.delenv("SLURM_NTASKS_PER_NODE")
    with pytest.raises(UserError, match="--nodes 1 --ntasks-per-node 2"):
        Team.start(cpu(2))


def test_torchrun_inside_a_job_goes_by_its_own_numbers(srun: Srun, monkeypatch: pytest.MonkeyPatch) -> None:
    srun(1, 2)
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "3")
    with pytest.raises(UserError, match=r"started 3 .*for 2"):
        Team.start(cpu(2))
    monkeypatch.setenv("WORLD_SIZE", "1")
    assert Team.start(cpu(1)).leads


def test_a_script_or_a_shell_inside_a_job_is_one_process(srun: Srun, monkeypatch: pytest.MonkeyPatch) -> None:
    srun(2)
    monkeypatch.delenv("SLURM_STEP_NUM_TASKS")  # a batch script: rank 0, and the job's number of tasks
    assert srun_tasks() == 1
    assert Team.start(cpu()).world == 1
    with pytest.raises(UserError, match="srun --nodes 2"):
        Team.start(cpu(1, nodes=2))
    monkeypatch.delenv("SLURM_PROCID")  # a shell of salloc
    assert Team.start(cpu()).world == 1
    assert TeamError("one has gone").exit_code == LOST
    monkeypatch.setenv("LOCAL_RANK", "1")  # started by Lightning's own launcher
    assert process_rank() == 1
    assert TeamError("one has gone").exit_code == 0, "the launcher kills the lead where one ends otherwise"


def test_a_checkpoint_of_lightnings_requeueing_is_not_taken_up(
    srun: Srun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    srun(1)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hpc_ckpt_1.ckpt").write_bytes(b"of another stage")
    (tmp_path / "x.yaml").write_text(RECIPE)
    before = signal.getsignal(signal.SIGUSR1)
    run = run_recipe(tmp_path / "x.yaml", tmp_path / "run", console=Console(quiet=True))
    assert (run / "stages/tokenizer/model.safetensors").is_file()
    assert signal.getsignal(signal.SIGUSR1) == before


def test_the_environment_is_slurms_only_under_srun(srun: Srun, monkeypatch: pytest.MonkeyPatch) -> None:
    srun(1)
    assert isinstance(environment(), LightningEnvironment), "alone"
    monkeypatch.setenv("SLURM_NTASKS", "2")
    monkeypatch.setenv("SLURM_NTASKS_PER_NODE", "2")
    assert isinstance(environment(), LightningEnvironment), "one process of a script that may use two"
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "2")
    monkeypatch.setenv("SLURM_JOB_NAME", "interactive")  # srun inside salloc
    found = environment()
    assert isinstance(found, SLURMEnvironment) and not found.auto_requeue
    with monkeypatch.context() as inside:
        for name in ("TORCHELASTIC_RUN_ID", "RANK", "GROUP_RANK", "LOCAL_RANK", "LOCAL_WORLD_SIZE"):
            inside.setenv(name, "0")
        assert environment() is None, "torchrun inside SLURM"
    monkeypatch.delenv("SLURM_NTASKS")
    assert environment() is None


@pytest.mark.slow
def test_two_tasks_of_srun_train_together(
    srun: Srun, monkeypatch: pytest.MonkeyPatch, start: Callable[..., Any], tmp_path: Path
) -> None:
    (tmp_path / "x.yaml").write_text(RECIPE)
    command = ("run", tmp_path / "x.yaml", "-o", tmp_path / "run", "--set")
    for devices, code in ((1, 2), (2, 0)):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        processes = []
        for rank in (0, 1):
            srun(2, rank=rank, MASTER_PORT=str(port), SLURM_NODELIST="127.0.0.1")
            processes.append(start(*command, f"hardware.devices={devices}"))
        for process in processes:
            output = process.communicate(timeout=120)[0]
            assert process.returncode == code, output
            assert code == 0 or "srun started 2 processes" in output
    assert (tmp_path / "run/stages/tokenizer/model.safetensors").is_file()


def cores(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setattr("motionloom.pipeline.launch.hardware.usable_cores", lambda: count)


def test_processes_on_a_cpu_are_one_a_core_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    cores(monkeypatch, 2)
    assert Hardware().resolved_devices() == 1
    assert Hardware(cpu_devices=2).world() == 2
    assert Hardware(cpu_devices=4).resolved_devices() == 2
    assert Hardware(cpu_devices=2, devices=3).resolved_devices() == 3, "a number that is asked for is taken"
    cores(monkeypatch, 1)
    assert Hardware(cpu_devices=2).resolved_devices() == 1
    # GPUs do not heed it.
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    cores(monkeypatch, 8)
    assert Hardware(cpu_devices=4).resolved_devices() == 1
    assert Hardware(cpu_devices=4, accelerator="cpu").resolved_devices() == 4
    with pytest.raises(UserError, match="cpu_devices"):
        Hardware.parse({"cpu_devices": 0}, "hardware")


@pytest.mark.parametrize(
    ("gpus", "asked", "refused"),
    [
        (0, {"devices": 8}, True),
        (0, {"devices": 8, "accelerator": "gpu"}, True),
        (2, {"devices": 3}, True),
        (2, {"devices": 2}, False),
        (2, {}, False),
        (0, {"devices": 8, "accelerator": "cpu"}, False),
        (0, {"devices": 1}, False),
    ],
)
def test_devices_that_are_not_here_are_refused(
    gpus: int, asked: dict[str, Any], refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    with pytest.raises(UserError, match=r"hardware\.devices") if refused else nullcontext():
        Hardware.parse(asked, "hardware").require_devices()


# One process of a run dies, stops or hangs: the launcher, or a time-out, ends them all.

TORCHRUN = (sys.executable, "-P", "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")


@pytest.fixture
def jobs() -> Iterator[Jobs]:
    """Starts jobs of two processes; nothing of them outlives the test."""
    started = Jobs()
    yield started
    started.end()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks up processes in /proc")
@pytest.mark.parametrize("rank", [0, 1])
def test_the_others_end_when_one_dies(jobs: Jobs, tmp_path: Path, rank: int) -> None:
    """Processes of Lightning's launcher, which `motionloom run` uses on one machine."""
    job = jobs.start(tmp_path, "goes", (sys.executable, "-P"))
    wait_for_step(tmp_path, 5)
    pids = [pid_of(tmp_path, one) for one in range(2)]
    os.kill(pids[rank], signal.SIGKILL)
    said = end_of(job, pids)
    who = f"process 1 of this machine (pid {pids[1]})" if rank else f"rank 0 (process {pids[0]} on"
    assert who in said and ("SIGKILL" in said) == bool(rank) and ".cc:" not in said


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks up processes in /proc")
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
    said = end_of(job, pids)
    assert how == "stops" or "process 1: no step for 15 s, it hangs in " in said
    found = {path.name: path.read_text() for path in tmp_path.rglob("stalled_rank_*")}
    assert found and any("__getitem__" in text for text in found.values()) is (how == "hangs")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks up processes in /proc")
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
