"""A launch plan on a real SLURM of two nodes: the order of its jobs, a job queued again, a failure."""

from __future__ import annotations

import io
import os
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from slurm_cluster import Cluster, why_not

from motionloom.pipeline.runs import slurm
from motionloom.pipeline.runs.launch_plan import LaunchPlan, SlurmOptions, make_launch_plan
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.runs.slurm import submit_run

pytestmark = [pytest.mark.slurm, pytest.mark.skipif(bool(why_not()), reason=why_not())]
WORDS = ["light_cpus=1", "cpus_per_gpu=1", "light_memory_gb=0.5", "memory_gb_per_gpu=0.5"]
OPTIONS = SlurmOptions.from_words([*WORDS, "extra.comment=two words"])


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with Cluster() as started, pytest.MonkeyPatch.context() as patch:
        for name, value in started.environment.items():
            patch.setenv(name, value)
        yield started


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Puts a line of shell in the place of `motionloom`; jobs run in a folder whose name has a blank."""
    folder = tmp_path / "a folder"
    folder.mkdir()
    monkeypatch.chdir(folder)

    def put(line: str) -> None:
        monkeypatch.setattr(slurm, "PROGRAM", ("sh", "-c", line, "motionloom"))

    return put


def plan(nodes: int = 2) -> LaunchPlan:
    return make_launch_plan(
        load_recipe("humantomato-tiny"),
        OPTIONS,
        given="humantomato-tiny",
        overrides=(),
        out=Path("run").absolute(),
        nodes=nodes,
        gpus_per_node=0,
    )


def submitted(made: LaunchPlan) -> list[str]:
    return submit_run(made, OPTIONS, Console(file=io.StringIO()))


def until(ready: Callable[[], object], seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < deadline
        time.sleep(0.3)


def states(cluster: Any, ids: list[str]) -> list[str]:
    shown = cluster.ask("squeue", "--noheader", "--states=all", "--format=%A %T", f"--jobs={','.join(ids)}")
    found = dict(line.split() for line in shown.splitlines())
    return [found.get(job, "") for job in ids]


def test_a_warned_job_starts_again_and_the_next_waits_for_it(
    cluster: Any, program: Callable[[str], None]
) -> None:
    once = 'case $SLURM_JOB_NAME in *1-data) [ -n "$SLURM_RESTART_COUNT" ] || sleep 60;; esac'
    program(f'echo "$SLURM_JOB_NAME ${{SLURM_RESTART_COUNT:-0}}" >> order; {once}')
    ids = submitted(plan(nodes=1))
    until(lambda: Path("order").is_file())
    # What SLURM sends before a time limit.
    subprocess.run(["scancel", "--batch", "--signal=USR1", ids[0]], check=True, env=os.environ)
    until(lambda: states(cluster, ids) == ["COMPLETED"] * 3, 180)
    names = [f"humantomato-tiny-{name}" for name in ("1-data", "1-data", "2-train", "3-generate")]
    assert Path("order").read_text().splitlines() == [
        f"{name} {count}" for name, count in zip(names, (0, 1, 0, 0), strict=True)
    ]
    (log,) = Path("run").glob(f".slurm/*/1-data-{ids[0]}.log")
    assert "queued again" in log.read_text()


def test_a_saved_job_starts_again_unless_it_was_cancelled(
    cluster: Any, program: Callable[[str], None]
) -> None:
    program("echo x >> order; trap 'exit 75' TERM; while :; do sleep 0.1; done")
    ids = submitted(plan(nodes=1))
    starts = lambda: Path("order").read_text().count("x") if Path("order").is_file() else 0  # noqa: E731
    until(lambda: starts() == 1)
    # How a preemption's grace time begins; the job goes on running.
    subprocess.run(["scancel", "--batch", "--signal=TERM", ids[0]], check=True, env=os.environ)
    until(lambda: starts() == 2, 180)
    subprocess.run(["scancel", ids[0]], check=True, env=os.environ)
    until(lambda: states(cluster, ids) == ["CANCELLED"] * 3)
    time.sleep(3)  # longer than the command takes to answer
    assert states(cluster, ids)[0] == "CANCELLED" and starts() == 2


def test_what_follows_a_failure_is_cancelled(cluster: Any, program: Callable[[str], None]) -> None:
    program("case $SLURM_JOB_NAME in *2-train) exit 5;; esac")
    ids = submitted(plan(nodes=1))
    until(lambda: states(cluster, ids)[2] == "CANCELLED")
    assert states(cluster, ids) == ["COMPLETED", "FAILED", "CANCELLED"]
