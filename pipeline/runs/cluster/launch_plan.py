"""A recipe cut into groups of stages for a cluster: one job per branch of its graph, with its own machines.

An engine schedules (`slurm.py`, `kubernetes.py`, `sky.py`); this only describes. A group is one command,
`motionloom run RECIPE -o OUT --until LAST`, whose selection covers exactly the stages of the group and what
the groups before have made.
Groups that do not wait for each other run at the same time in one run folder (`execute.py`). The run graph
decides what is done: a group that is started twice, after a kill or by mistake, skips what is finished and
resumes what is not.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.contract.stage import Stage
from motionloom.pipeline.launch.cluster import ClusterOptions
from motionloom.pipeline.runs.plan import require_fit
from motionloom.pipeline.runs.recipe import Recipe
from motionloom.pipeline.training.config import TrainedStageConfig


@dataclass(frozen=True)
class Machines:
    """Nodes and processes of a group."""

    nodes: int
    processes: int
    """On each node, as `gpus` are."""
    gpus: int


@dataclass(frozen=True)
class Group:
    """Stages that run as one job."""

    name: str
    """A word of lower-case letters, digits and dashes; the first character is a digit."""
    stages: tuple[str, ...]
    last: tuple[str, ...]
    """Stages that no other stage of the group reads."""
    after: tuple[str, ...]
    """Names of the groups, all before this one, that must have succeeded."""
    machines: Machines
    settings: tuple[str, ...]
    """Settings of `hardware`, as `--set` takes them."""
    parts: int = 1
    """Jobs of the array that it is, each for one part of its conversions."""
    left: tuple[int, ...] | None = None
    """Numbers of the parts that are missing, where some are made."""


@dataclass(frozen=True)
class LaunchPlan:
    """A recipe as groups."""

    name: str
    """Name of the jobs: lower-case letters, digits and dashes, a letter first."""
    recipe: Recipe
    out: str
    groups: tuple[Group, ...]
    go_on: tuple[str, ...] = ()
    """Trainings that go on although what they compute has changed."""

    def job(self, group: Group) -> str:
        """Name of a group's job."""
        return f"{self.name}-{group.name}"

    def command(self, group: Group, recipe: str, program: Sequence[str]) -> list[str]:
        """The words that run a group: `program` is `motionloom`, `recipe` the file of the resolved recipe."""
        sets = [word for setting in group.settings for word in ("--set", setting)]
        return [
            *program,
            "run",
            recipe,
            "-o",
            self.out,
            "--until",
            ",".join(group.last),
            *(word for name in group.stages if name in self.go_on for word in ("--go-on", name)),
            *sets,
        ]

    def lines(self, options: ClusterOptions) -> list[str]:
        """A line for each group: its stages and its machines."""
        out = []
        for group in self.groups:
            at = group.machines
            each = f"{at.processes} processes, {at.gpus} GPUs, {options.cpus * at.processes} cores"
            stages = ", ".join(group.stages) + (f" in {group.parts} parts" if group.parts > 1 else "")
            after = f", after {', '.join(group.after)}" if group.after else ""
            out.append(f"{group.name}: {stages}; {at.nodes} x ({each}){after}")
        return out


def make_launch_plan(
    recipe: Recipe,
    options: ClusterOptions,
    *,
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
    jobs = _jobs(recipe, options, nodes, gpus_per_node)
    names: dict[str, str] = {}  # stage -> its group
    waits: dict[str, set[str]] = {}  # group -> all groups before it
    for job in jobs:
        each = min(job.processes, max(gpus_per_node, 1))
        on_node = int(job.gpu) if job.light else each if gpus_per_node else 0
        machines = Machines(job.processes // each, each, on_node)
        settings = _settings(job, machines, options)
        first: tuple[str, ...] = ()
        if options.parts > 1 and (cut := tuple(stage.name for stage in job.stages if stage.kind.parts)):
            # The group behind it finds the parts made, and joins them.
            name = f"{len(groups) + 1}-parts"
            groups.append(Group(name, cut, cut, (), machines, settings, options.parts))
            waits[name], first = set(), (name,)
        stages = tuple(stage.name for stage in job.stages)
        trained = [stage.name for stage in job.stages if stage.kind.trains]
        name = f"{len(groups) + 1}-{_word((trained or stages)[0], 20)}"
        # `--until` takes all that its stages need, so the last ones name the whole group.
        read = {source for stage in job.stages for source in stage.inputs.values()}
        direct = {*first, *(names[source] for source in read if source in names)}
        implied = {group for one in direct for group in waits[one]}
        waits[name] = direct | implied
        names |= dict.fromkeys(stages, name)
        groups.append(
            Group(
                name=name,
                stages=stages,
                last=tuple(stage for stage in stages if stage not in read),
                after=tuple(group for group in waits if group in direct - implied),
                machines=machines,
                settings=settings,
            )
        )
    for group in groups:
        # What is installed here says nothing of the cluster, so loggers are not asked after.
        there = {"nodes": group.machines.nodes, "devices": group.machines.processes, "loggers": ()}
        there["accelerator"] = "gpu" if group.machines.gpus else "cpu"
        require_fit(map(recipe.stage, group.stages), recipe.hardware.model_copy(update=there))
    word = _word(recipe.name, 30)
    name = word if word[:1].isalpha() else f"run-{word}"
    return LaunchPlan(name, recipe, str(out), tuple(groups), tuple(go_on))


def _settings(job: _Job, machines: Machines, options: ClusterOptions) -> tuple[str, ...]:
    fields = [f"nodes={machines.nodes}", f"devices={machines.processes}"]
    if job.light:
        fields.append(f"convert_workers={options.cpus}")
    # A node whose driver is broken must not do a GPU's work on its CPU.
    fields.append(f"accelerator={'gpu' if job.gpu else 'cpu'}")
    return tuple(f"hardware.{field}" for field in fields)


@dataclass
class _Job:
    """A group that grows."""

    light: bool
    """One process, of stages that neither train nor divide their work."""
    gpu: bool
    processes: int
    stages: list[Stage]
    before: set[int]
    """Places, among the jobs, of all that it waits for."""


def _jobs(recipe: Recipe, options: ClusterOptions, nodes: int, gpus: int) -> list[_Job]:
    """The stages as jobs, each behind those that it waits for.

    A stage goes on in a job that would not wait for more because of it and whose trainings are all above it,
    so that no training waits for one that it does not need. Light stages wait together: every job waits in
    the queue once.
    """
    jobs: list[_Job] = []
    place: dict[str, int] = {}  # stage -> its job
    above: dict[str, set[str]] = {}
    for stage in recipe.stages:
        own = [name for name in stage.inputs.values() if name in place]
        above[stage.name] = {*own, *(name for source in own for name in above[source])}
        direct = {place[name] for name in own}
        before = direct.union(*(jobs[at].before for at in direct))
        trains = stage.kind.trains
        heavy = stage.kind.heavy
        new = _Job(
            light=not heavy,
            gpu=gpus > 0 and (heavy or any(recipe.stage(name).kind.trains for name in above[stage.name])),
            processes=_processes(stage, options, nodes, gpus),
            stages=[],
            before=before,
        )
        for at, job in enumerate(jobs):
            trained = {one.name for one in job.stages if one.kind.trains}
            alike = (job.light, job.gpu, job.processes) == (new.light, new.gpu, new.processes)
            if trained:
                fits = (
                    (alike or not trains)
                    and not new.light
                    and trained <= above[stage.name]
                    and before <= {at, *job.before}
                )
            else:
                fits = alike and not trains and not any(at in jobs[other].before for other in before)
            if fits:
                break
        else:
            at = len(jobs)
            job = new
            jobs.append(job)
        job.stages.append(stage)
        place[stage.name] = at
        job.before |= before - {at}
        for other in jobs:
            if at in other.before:
                other.before |= job.before
    # Each waits for more than those that it waits for.
    return sorted(jobs, key=lambda job: len(job.before))


def _processes(stage: Stage, options: ClusterOptions, nodes: int, gpus: int) -> int:
    """How many a stage can use: whole nodes, or a part of one, among which its batch divides."""
    each = max(gpus, 1)
    if not stage.kind.trains:
        return nodes * each if stage.kind.heavy else 1
    if not isinstance(stage.config, TrainedStageConfig) or stage.config.train.strategy == "fsdp":
        return nodes * each
    train = stage.config.train
    most = min(nodes * each, train.batch_size // options.clips_per_gpu)
    counts = [count for count in range(2, most + 1) if count <= each or count % each == 0]
    return max([1, *(count for count in counts if train.batch_size % (count * train.accumulate) == 0)])


def _word(text: str, longest: int) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:longest].strip("-")
