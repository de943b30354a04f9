"""A recipe from one command on a real SLURM of two nodes, and its training preempted by urgent jobs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from preempted import GROUPS, Launched, launch, preempt, write_recipe
from slurm_cluster import Cluster, why_not

pytestmark = [
    pytest.mark.slurm,
    pytest.mark.timeout(600),
    pytest.mark.skipif(bool(why_not()), reason=why_not()),
]
STEPS = 100
TRIGGERS = (5, 45)
"""Steps behind which it is disturbed: by an urgent job and the warning before it, by a plain SIGTERM."""


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


def test_a_training_preempted_twice_equals_the_undisturbed_one(calm: Launched, recipe: Path) -> None:
    """No step is trained twice: the signal before the end has the training save the one it is at."""
    seen = preempt(calm, recipe, calm.run.with_name("preempted"), TRIGGERS, ended=TRIGGERS[1:])
    assert seen.exact, seen
    assert seen.steps == STEPS and seen.repeated == 0, seen
    assert [one.first_step - one.last_step for one in seen.restarts] == [1, 1]
    assert 0 < seen.restarts[0].last_step < seen.restarts[1].last_step < STEPS - 1
