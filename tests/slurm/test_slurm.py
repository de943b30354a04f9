"""A real SLURM of two nodes: a recipe from one command, its training preempted, cancelled and failed jobs."""

from __future__ import annotations

import io
import os
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from preempted import GROUPS, Launched, launch, preempt, write_recipe
from rich.console import Console
from slurm_cluster import Cluster, why_not

from motionloom.pipeline.launch.cluster import ClusterOptions
from motionloom.pipeline.runs.cluster import slurm
from motionloom.pipeline.runs.cluster.launch_plan import LaunchPlan, make_launch_plan
from motionloom.pipeline.runs.cluster.slurm import submit_run
from motionloom.pipeline.runs.recipe import load_recipe

pytestmark = [
    pytest.mark.slurm,
    pytest.mark.timeout(600),
    pytest.mark.skipif(bool(why_not()), reason=why_not()),
]
WORDS = ["cpus=1", "memory_gb=0.5"]
OPTIONS = ClusterOptions().with_words([*WORDS, "extra.comment=two words"])


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
        load_recipe("humantomato-tiny"), OPTIONS, out=Path("run").absolute(), nodes=nodes, gpus_per_node=0
    )


def submitted(made: LaunchPlan) -> list[str]:
    return submit_run([made], Path(made.out), OPTIONS, Console(file=io.StringIO()))


def until(ready: Callable[[], object], seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < deadline
        time.sleep(0.3)


def states(cluster: Any, ids: list[str]) -> list[str]:
    shown = cluster.ask("squeue", "--noheader", "--states=all", "--format=%A %T", f"--jobs={','.join(ids)}")
    found = dict(line.split() for line in shown.splitlines())
    return [found.get(job, "") for job in ids]


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
    until(lambda: states(cluster, ids) == ["CANCELLED"] * len(ids))
    time.sleep(3)  # longer than the command takes to answer
    assert states(cluster, ids)[0] == "CANCELLED" and starts() == 2


def test_what_follows_a_failure_is_cancelled(cluster: Any, program: Callable[[str], None]) -> None:
    """And another branch is not: the face's."""
    program("case $SLURM_JOB_NAME in *4-tma) exit 5;; esac")
    made = plan(nodes=1)
    ids = submitted(made)
    until(lambda: {*states(cluster, ids)} == {"FAILED", "CANCELLED", "COMPLETED"})
    ends = dict(zip((group.name for group in made.groups), states(cluster, ids), strict=True))
    assert [ends[name] for name in ("4-tma", "5-gpt", "3-face-tokenizer")] == [
        "FAILED",
        "CANCELLED",
        "COMPLETED",
    ]


def test_a_sweep_runs_row_by_row(cluster: Any, program: Callable[[str], None]) -> None:
    """In the order of its groups each; and sbatch takes all scripts once more, to test them alone."""
    program('echo "$SLURM_ARRAY_TASK_ID $SLURM_JOB_NAME" >> order')
    folder, made = Path("run").absolute(), plan(nodes=1)
    rows = [replace(made, out=str(folder / row)) for row in ("seed=1", "seed=2")]
    submit_run(rows, folder, OPTIONS, Console(file=io.StringIO()))
    for script in folder.glob(".slurm/*/*.sbatch"):
        subprocess.run(["sbatch", "--test-only", str(script)], check=True, env=os.environ)
    wanted = [made.job(group) for group in made.groups]
    until(lambda: Path("order").is_file() and len(Path("order").read_text().split()) == 4 * len(wanted), 180)
    order = [line.split() for line in Path("order").read_text().splitlines()]
    for row in ("1", "2"):
        done = [job for number, job in order if number == row]
        assert sorted(done) == wanted and all(
            done.index(made.job(group))
            > max((done.index(f"{made.name}-{one}") for one in group.after), default=-1)
            for group in made.groups
        )


STEPS = 100
TRIGGERS = (5, 45)
"""Steps behind which it is disturbed: by an urgent job and the warning before it, by a plain SIGTERM."""


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recipe(tmp_path_factory.mktemp("recipe"), STEPS)


@pytest.fixture(scope="module")
def calm(cluster: Cluster, recipe: Path) -> Launched:
    """The recipe, undisturbed."""
    launched = launch(cluster, recipe, recipe.parent / "calm")
    launched.wait_for_end()
    return launched


def test_one_command_converts_trains_and_evaluates_on_two_nodes(calm: Launched) -> None:
    assert calm.states() == ["COMPLETED"] * len(GROUPS), calm.logs()
    stages = calm.run / "stages"
    finished = {path.parent.name for path in stages.glob("*/artifact.json")}
    assert finished == {"data", "stats", "tokenizer", "evaluate"}
    assert (stages / "evaluate/metrics.json").is_file()
    trained = [(rank, row["step"]) for rank, row in calm.rows()]
    assert sorted(trained) == [(rank, step) for rank in (0, 1) for step in range(STEPS)]


def test_a_training_preempted_twice_equals_the_undisturbed_one(calm: Launched, recipe: Path) -> None:
    """No step is trained twice: the signal before the end has the training save the one it is at."""
    seen = preempt(calm, recipe, calm.run.with_name("preempted"), TRIGGERS, ended=TRIGGERS[1:])
    assert seen.exact, seen
    assert seen.steps == STEPS and seen.repeated == 0, seen
    assert [one.first_step - one.last_step for one in seen.restarts] == [1, 1]
    assert 0 < seen.restarts[0].last_step < seen.restarts[1].last_step < STEPS - 1
