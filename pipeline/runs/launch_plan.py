"""A recipe cut into groups of stages for a cluster, one after the other, each with its own machines.

SLURM schedules (`slurm.py`); this only describes. A group is one command, `motionloom run RECIPE -o OUT
--until LAST`, whose selection covers exactly the stages of the group: the groups before have made what they
need. The run graph decides what is done: a group that is started twice, after a kill or by mistake, skips
what is finished and resumes what is not.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from motionloom.datasets.schema import Config, UserError
from motionloom.pipeline.contract.stage import Stage
from motionloom.pipeline.runs.plan import require_fit
from motionloom.pipeline.runs.recipe import Recipe

Need = Literal["cpu", "gpu", "all"]
"""One process without a GPU; one process with one; as many processes on all nodes as there are GPUs."""


def _one_line(text: str) -> str:
    if not text or not text.isprintable():
        raise ValueError("write one line of printable characters")
    return text


Line = Annotated[str, AfterValidator(_one_line)]
"""Text of one line: a batch script must not get another."""


class SlurmOptions(Config):
    """Options of SLURM jobs: `motionloom launch --cluster KEY=VALUE`."""

    partition: Line | None = None
    """Partition of the groups with GPUs, and of the others if `light_partition` is not given; default the
    cluster's."""
    light_partition: Line | None = None
    """Partition of the groups without GPUs."""
    account: Line | None = None
    """Account that is charged."""
    time_minutes: int = Field(1440, ge=1)
    """Time limit of a group that takes all machines."""
    light_minutes: int = Field(240, ge=1)
    """Time limit of the other groups."""
    cpus_per_gpu: int = Field(8, ge=1)
    """CPU cores for each process that trains."""
    memory_gb_per_gpu: float = Field(64, gt=0)
    """Memory for each process that trains."""
    light_cpus: int = Field(8, ge=1)
    """CPU cores, and processes of a conversion, in a group of one process."""
    light_memory_gb: float = Field(32, gt=0)
    """Memory of a group of one process."""
    warn_seconds: int = Field(120, ge=60)
    """Seconds before its time limit at which a job is queued again."""
    requeues: int = Field(100, ge=0)
    """Times that one job may be queued again at its time limit; 0 lets it end there."""
    extra: dict[str, Line] = Field(default_factory=dict)
    """More options of sbatch: `extra.constraint=h100`, `extra.qos=high`."""

    @field_validator("extra")
    @classmethod
    def _are_options(cls, extra: dict[str, str]) -> dict[str, str]:
        for name in extra:
            if not re.fullmatch(r"[a-z][a-z0-9-]*", name):
                raise ValueError(f"'{name}': an sbatch option is a word such as 'mail-type'")
        return extra

    @model_validator(mode="after")
    def _warned_in_time(self) -> Self:
        if 2 * self.warn_seconds > 60 * min(self.time_minutes, self.light_minutes):
            raise ValueError(
                f"warn_seconds {self.warn_seconds} is more than half of a time limit: jobs would be "
                f"queued again before they have done anything; raise time_minutes and light_minutes"
            )
        return self

    @classmethod
    def from_words(cls, words: Sequence[str]) -> Self:
        """From `KEY=VALUE` words; `extra.KEY=VALUE` is an option of sbatch."""
        fields: dict[str, object] = {}
        extra: dict[str, str] = {}
        for word in words:
            key, equals, value = word.partition("=")
            if not equals:
                raise UserError(f"--cluster '{word}': write KEY=VALUE, for example partition=gpu")
            if key.startswith("extra."):
                extra[key.removeprefix("extra.")] = value
            else:
                fields[key] = value
        return cls.parse({**fields, "extra": extra} if extra else fields, "--cluster")


@dataclass(frozen=True)
class Machines:
    """Nodes, processes and limits of a group."""

    nodes: int
    processes: int
    """On each node, as `gpus`, `cpus` and `memory_gb` are."""
    gpus: int
    cpus: int
    memory_gb: float
    minutes: int


@dataclass(frozen=True)
class Group:
    """Stages that run as one job, after the group before."""

    name: str
    """A word of lower-case letters, digits and dashes; the first character is a digit."""
    stages: tuple[str, ...]
    last: tuple[str, ...]
    """Stages that no other stage of the group reads."""
    machines: Machines
    settings: tuple[str, ...]
    """Settings of `hardware`, as `--set` takes them."""


@dataclass(frozen=True)
class LaunchPlan:
    """A recipe as groups."""

    name: str
    """Name of the jobs: lower-case letters, digits and dashes, a letter first."""
    recipe: Recipe
    shipped: str | None
    """A shipped recipe's name; None for a recipe of the user's own, which travels in its resolved form."""
    overrides: tuple[str, ...]
    out: str
    groups: tuple[Group, ...]
    go_on: tuple[str, ...] = ()
    """Trainings that go on although what they compute has changed."""

    def job(self, group: Group) -> str:
        """Name of a group's job."""
        return f"{self.name}-{group.name}"

    def command(self, group: Group, recipe: str, program: Sequence[str]) -> list[str]:
        """The words that run a group: `program` is `motionloom`, `recipe` the file of an own recipe."""
        overrides = self.overrides if self.shipped else ()  # a resolved recipe has them
        sets = [word for setting in (*overrides, *group.settings) for word in ("--set", setting)]
        return [
            *program,
            "run",
            self.shipped or recipe,
            "-o",
            self.out,
            "--until",
            ",".join(group.last),
            *(word for name in group.stages if name in self.go_on for word in ("--go-on", name)),
            *sets,
        ]

    def lines(self) -> list[str]:
        """A line for each group: its stages, its machines and their time limit."""
        out = []
        for group in self.groups:
            at = group.machines
            each = f"{at.processes} processes, {at.gpus} GPUs, {at.cpus} cores"
            stages = ", ".join(group.stages)
            out.append(f"{group.name}: {stages}; {at.nodes} x ({each}), at most {at.minutes} min")
        return out


def make_launch_plan(
    recipe: Recipe,
    options: SlurmOptions,
    *,
    shipped: str | None,
    overrides: Sequence[str],
    out: Path,
    nodes: int,
    gpus_per_node: int,
    go_on: Sequence[str] = (),
) -> LaunchPlan:
    """Cut a recipe into groups."""
    if nodes < 1 or gpus_per_node < 0:
        raise UserError(
            f"--nodes {nodes} --gpus-per-node {gpus_per_node}: take 1 node or more and no negative count"
        )
    groups: list[Group] = []
    for need, stages in _cut(recipe, gpus_per_node):
        names = tuple(stage.name for stage in stages)
        # `--until` takes all that its stages need, so the last ones name the whole group.
        read = {name for stage in stages for name in stage.inputs.values()}
        label = "train" if any(stage.kind.trains for stage in stages) else _word(names[0], 12)
        machines = _machines(options, need, nodes, gpus_per_node)
        groups.append(
            Group(
                name=f"{len(groups) + 1}-{label}",
                stages=names,
                last=tuple(name for name in names if name not in read),
                machines=machines,
                settings=_settings(options, need, machines),
            )
        )
    for group in groups:
        # What is installed here says nothing of the cluster, so loggers are not asked after.
        there = {"nodes": group.machines.nodes, "devices": group.machines.processes, "loggers": ()}
        there["accelerator"] = "gpu" if group.machines.gpus else "cpu"
        require_fit(map(recipe.stage, group.stages), recipe.hardware.model_copy(update=there))
    word = _word(recipe.name, 30)
    name = word if word[:1].isalpha() else f"run-{word}"
    return LaunchPlan(name, recipe, shipped, tuple(overrides), str(out), tuple(groups), tuple(go_on))


def _machines(options: SlurmOptions, need: Need, nodes: int, gpus: int) -> Machines:
    if need != "all":
        light = options.light_cpus, options.light_memory_gb, options.light_minutes
        return Machines(1, 1, int(need == "gpu"), *light)
    each = max(gpus, 1)
    cpus, memory = options.cpus_per_gpu * each, options.memory_gb_per_gpu * each
    return Machines(nodes, each, gpus, cpus, memory, options.time_minutes)


def _settings(options: SlurmOptions, need: Need, machines: Machines) -> tuple[str, ...]:
    fields = [f"nodes={machines.nodes}", f"devices={machines.processes}"]
    if need != "all":
        fields.append(f"convert_workers={options.light_cpus}")
    # A node whose driver is broken must not do a GPU's work on its CPU.
    fields.append(f"accelerator={'gpu' if machines.gpus else 'cpu'}")
    return tuple(f"hardware.{field}" for field in fields)


def _cut(recipe: Recipe, gpus: int) -> list[tuple[Need, list[Stage]]]:
    """Runs of stages that need the same, in an order that can run.

    A stage is put forward into an earlier group where all that it reads is there: every group waits in the
    queue once.
    """
    needs = _needs(recipe, gpus)
    waiting = list(recipe.stages)
    done: set[str] = set()
    out: list[tuple[Need, list[Stage]]] = []
    while waiting:
        ready = [stage for stage in waiting if done.issuperset(stage.inputs.values())]
        # A stage that needs the same machines goes on in the same job, whatever its place in the recipe.
        same = [stage for stage in ready if out and needs[stage.name] == out[-1][0]]
        if not same:
            out.append((needs[ready[0].name], []))
            same = [ready[0]]
        out[-1][1].append(same[0])
        done.add(same[0].name)
        waiting.remove(same[0])
    return out


def _needs(recipe: Recipe, gpus: int) -> dict[str, Need]:
    """By stage: what trains, or divides its work, takes all; what reads a trained network takes one GPU."""
    needs: dict[str, Need] = {}
    for stage in recipe.stages:
        if stage.kind.trains or stage.kind.shares:
            needs[stage.name] = "all"
        elif gpus and any(needs[name] != "cpu" for name in stage.inputs.values()):
            needs[stage.name] = "gpu"
        else:
            needs[stage.name] = "cpu"
    return needs


def _word(text: str, longest: int) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:longest].strip("-")
