"""A recipe cut into groups: exactly its stages, in an order that can run, on machines that they can use."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.launch.cluster import ClusterOptions
from motionloom.pipeline.runs.cluster.launch_plan import LaunchPlan, make_launch_plan
from motionloom.pipeline.runs.layers import shipped_recipes
from motionloom.pipeline.runs.plan import Selection, selected
from motionloom.pipeline.runs.recipe import load_recipe


def plan_of(name: str | Path, *overrides: str, nodes: int = 1, gpus: int = 1, parts: int = 1) -> LaunchPlan:
    return make_launch_plan(
        load_recipe(name, overrides),
        ClusterOptions(parts=parts),
        out=Path("/runs/x"),
        nodes=nodes,
        gpus_per_node=gpus,
    )


def stages(plan: LaunchPlan) -> list[tuple[str, ...]]:
    return [group.stages for group in plan.groups]


# Those that start from a model of the package need its weights: test_finetune.py.
@pytest.mark.parametrize("name", sorted({*shipped_recipes()} - {"finetune"}))
def test_groups_select_their_stages_and_trainings_take_all_gpus(name: str) -> None:
    plan = plan_of(name)
    done: set[str] = set()
    for group in plan.groups:
        reached = selected(plan.recipe, Selection(until=",".join(group.last)))
        assert reached - done == set(group.stages)
        done |= reached
    assert done == {stage.name for stage in plan.recipe.stages}

    plan = plan_of(name, nodes=2, gpus=8)
    for group in plan.groups:
        kinds = [plan.recipe.stage(stage).kind for stage in group.stages]
        heavy = [kind.heavy for kind in kinds]
        assert all(heavy) if any(heavy) else (group.machines.nodes, group.machines.processes) == (1, 1)


def test_a_job_per_branch_of_the_paper() -> None:
    """No training waits for one that it does not read; each takes the GPUs that its batch has clips for."""
    plan = plan_of("humantomato-paper", nodes=2, gpus=8)
    assert {
        group.stages: (group.after, group.machines.nodes, group.machines.gpus) for group in plan.groups
    } == {
        ("data", "stats", "text"): ((), 1, 0),
        ("tokenizer", "tokens"): (("1-data",), 1, 8),
        ("face_tokenizer", "face_tokens", "face_gpt"): (("1-data",), 1, 8),
        ("tma",): (("1-data",), 1, 8),
        ("evaluator",): (("1-data",), 1, 1),
        ("gpt",): (("2-tokenizer", "4-tma"), 1, 8),
        ("evaluate",): (("3-face-tokenizer", "5-evaluator", "6-gpt"), 2, 8),
        ("generate", "report"): (("7-evaluate",), 1, 1),
    }
    first, second, last = plan.groups[0], plan.groups[1], plan.groups[-1]
    assert second.settings == ("hardware.nodes=1", "hardware.devices=8", "hardware.accelerator=gpu")
    assert "hardware.accelerator=cpu" in first.settings and "hardware.accelerator=cpu" not in last.settings
    words = plan.command(plan.groups[5], "r.yaml", ["motionloom"])
    assert words[:7] == ["motionloom", "run", "r.yaml", "-o", "/runs/x", "--until", "gpt"]


@pytest.mark.parametrize(
    ("override", "gpus", "wanted"),
    [
        ("train.batch_size=512", 8, (2, 8)),
        ("train.batch_size=96", 8, (1, 3)),
        ("train.batch_size=448", 8, (1, 8)),  # not 14: two nodes of seven
        ("train.batch_size=256", 7, (1, 4)),
        ("train.batch_size=31", 8, (1, 1)),
    ],
)
def test_a_training_takes_gpus_that_divide_its_batch(
    override: str, gpus: int, wanted: tuple[int, int]
) -> None:
    plan = plan_of("humantomato-paper", f"tma.{override}", nodes=2, gpus=gpus)
    machines = next(group.machines for group in plan.groups if "tma" in group.stages)
    assert (machines.nodes, machines.gpus) == wanted


def test_a_training_that_goes_on_is_named_to_its_own_group() -> None:
    plan = replace(plan_of("humantomato-paper"), go_on=("gpt",))
    told = [plan.command(group, "r.yaml", ["motionloom"]) for group in plan.groups]
    assert [words[words.index("--go-on") + 1] for words in told if "--go-on" in words] == ["gpt"]
    assert "gpt" in plan.groups[next(i for i, words in enumerate(told) if "--go-on" in words)].stages


def test_a_conversion_in_parts_is_joined_by_the_group_behind_it() -> None:
    parts, data, train, *_ = plan_of("bvh-body", parts=8).groups
    assert (parts.stages, parts.after, parts.parts) == (("data",), (), 8)
    assert (data.stages, data.after, data.parts) == (("data", "stats", "text"), ("1-parts",), 1)
    assert train.after == ("2-data",)
    assert not any(group.parts > 1 for group in plan_of("humantomato-paper", parts=8).groups)


def test_without_gpus_all_is_for_cpus() -> None:
    plan = plan_of("ude-tiny", gpus=0, nodes=2)
    assert all(group.machines.gpus == 0 for group in plan.groups)
    assert all("hardware.accelerator=cpu" in group.settings for group in plan.groups)
    train = plan.groups[1]
    assert (train.machines.nodes, train.machines.processes) == (2, 1)


def test_names_suit_slurm(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text("extends: humantomato-paper\nname: 9.Own_Recipe-of-a-very-long-and-winding-name\n")
    plan = plan_of(path)
    assert plan.name == "run-9-own-recipe-of-a-very-long-an"
    assert max(len(plan.job(group)) for group in plan.groups) <= 56


@pytest.mark.parametrize(
    ("call", "message"), [({"nodes": 0}, "take 1 node or more"), ({"gpus": -1}, "take 1 node or more")]
)
def test_what_cannot_run_is_refused_before_it_waits(call: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        plan_of("humantomato-tiny", **call)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["partition"], "write KEY=VALUE"),
        (["partitoin=gpu"], "did you mean 'partition'"),
        (["partition=a\n#SBATCH --wrap=x"], "one line"),
        (["extra.comment=a\nrm -rf x"], "one line"),
        (["time_minutes=3"], "time_minutes"),
    ],
)
def test_wrong_options_are_explained(words: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        ClusterOptions().with_words(words)
