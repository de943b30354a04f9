"""A recipe from one command on a real SLURM of two nodes, and its training preempted by urgent jobs."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from kill_matrix import finished_files
from preempted import GROUPS, Launched, launch, preempt, restarts, started_at, write_recipe
from slurm_cluster import Cluster, why_not

pytestmark = [
    pytest.mark.slurm,
    pytest.mark.timeout(600),
    pytest.mark.skipif(bool(why_not()), reason=why_not()),
]
STEPS = 100
TRIGGERS = (5, 45)
"""Steps behind which an urgent job comes; SLURM takes some seconds to act, in which training goes on."""


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with Cluster() as started, pytest.MonkeyPatch.context() as patch:
        for name, value in started.environment.items():
            patch.setenv(name, value)
        yield started


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
    ends = {line.split()[-1] for line in calm.logs().splitlines() if line.startswith("parts on ")}
    assert not ends


def test_a_training_preempted_twice_equals_the_undisturbed_one(cluster: Cluster, calm: Launched) -> None:
    run = calm.run.with_name("preempted")
    shutil.copytree(calm.run, run, ignore=shutil.ignore_patterns(".slurm"))
    for name in ("tokenizer", "evaluate"):
        shutil.rmtree(run / "stages" / name)
    launched = launch(cluster, calm.run.with_name("preempted.yaml"), run, pause=0.1)
    starts = []
    for number, step in enumerate(TRIGGERS):
        preempt(launched, number, step)
        starts.append(started_at(launched))
    launched.wait_for_step(0, len(TRIGGERS))
    starts.append(started_at(launched))
    launched.wait_for_end()
    assert launched.states() == ["COMPLETED"] * len(GROUPS), launched.logs()
    expected = {(rank, row["step"]): (row["batch"], row["figures"]) for rank, row in calm.rows()}
    for rank, row in launched.rows():
        assert (row["batch"], row["figures"]) == expected[rank, row["step"]], (rank, row)
    for name in ("tokenizer", "evaluate"):
        ours, theirs = (finished_files(place.run / "stages" / name) for place in (launched, calm))
        assert ours == theirs
    for one in restarts(launched, starts):
        assert one.first_step <= one.last_step + 1
