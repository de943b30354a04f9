"""What a recipe needs of a cluster: its stages in groups, one after the other, each with its own machines.

An engine (SLURM, Kubernetes, SkyPilot) schedules; this only describes. A group is one command,
`motionloom run RECIPE -o OUT --until LAST`, whose selection covers exactly the stages of the group: what they
need has been made by the groups before. The run graph stays the judge of what is done: a group that is
started twice, after a kill or by mistake, skips what is finished and resumes what is not.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Literal

from rich.table import Table

from motionloom.datasets.convert.table import converter_named
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.stage import Stage
from motionloom.pipeline.launch.convert_job import Step
from motionloom.pipeline.launch.options import LaunchOptions
from motionloom.pipeline.runs.recipe import Recipe
from motionloom.pipeline.stages.convert import ConvertStage

Need = Literal["cpu", "gpu", "all"]
"""One process without a GPU; one process with one; as many processes on all nodes as there are GPUs."""

PARTS_MODULE = "motionloom.pipeline.cluster.convert_part"


@dataclass(frozen=True)
class Machines:
    """What a group runs on."""

    nodes: int
    processes: int
    """On each node."""
    gpus: int
    """Of each node."""
    cpus: int
    """Of each node."""
    memory_gb: float
    """Of each node."""
    minutes: int

    @property
    def memory_mib(self) -> int:
        """Memory of a node as clusters count it."""
        return max(1, round(self.memory_gb * 1024))


@dataclass(frozen=True)
class Parts:
    """A conversion's step that several machines make at once."""

    stage: str
    step: Step
    count: int


@dataclass(frozen=True)
class Group:
    """Stages that run as one job of the engine, after the group before."""

    name: str
    """A word of lower-case letters, digits and dashes; the first character is a digit."""
    need: Need
    stages: tuple[str, ...]
    last: tuple[str, ...]
    """Those of the stages that no other of the group needs."""
    machines: Machines
    settings: tuple[str, ...]
    """Of `hardware`, as `--set` takes them."""
    after: str | None = None
    """Name of the group that must be done before."""
    parts: Parts | None = None


@dataclass(frozen=True)
class LaunchPlan:
    """A recipe as groups."""

    name: str
    """Of the jobs: a word of lower-case letters, digits and dashes that begins with a letter."""
    recipe: Recipe
    given: str | None
    """A shipped recipe's name; None for a recipe of the user's own, which travels in its resolved form."""
    overrides: tuple[str, ...]
    out: str
    groups: tuple[Group, ...]

    def job(self, group: Group) -> str:
        """What a group's job is called."""
        return f"{self.name}-{group.name}"

    def command(self, group: Group, recipe: str, program: Sequence[str]) -> list[str]:
        """The words that run a group: `program` is `motionloom`, `recipe` the file of an own recipe."""
        sets = [word for setting in (*self._overrides, *group.settings) for word in ("--set", setting)]
        return [*program, "run", self.given or recipe, "-o", self.out, "--until", ",".join(group.last), *sets]

    def part_command(self, parts: Parts, recipe: str, python: Sequence[str]) -> list[str]:
        """The words that make one part of a conversion, whose number is in the engine's own variable."""
        where = [self.given or recipe, self.out, parts.stage, parts.step, str(parts.count)]
        return [*python, "-m", PARTS_MODULE, *where, *self._overrides]

    @property
    def _overrides(self) -> tuple[str, ...]:
        return self.overrides if self.given else ()  # a resolved recipe has them

    def table(self) -> Table:
        """For people."""
        table = Table(title=f"{self.recipe.name}: {len(self.groups)} groups", title_justify="left")
        for column in ("group", "stages", "machines", "limit", "after"):
            table.add_column(column, overflow="fold")
        for group in self.groups:
            stages = ", ".join(group.stages)
            if group.parts is not None:
                stages += f" ({group.parts.step} in {group.parts.count} parts)"
            limit = f"{group.machines.minutes} min"
            table.add_row(group.name, stages, _say_machines(group), limit, group.after or "")
        return table


def make_launch_plan(
    recipe: Recipe,
    options: LaunchOptions,
    *,
    given: str | None,
    overrides: Sequence[str],
    out: PurePosixPath,
    nodes: int,
    gpus_per_node: int,
    parts: int = 1,
) -> LaunchPlan:
    """Cut a recipe into groups; `parts` is into how many pieces conversions at its beginning are cut."""
    if nodes < 1 or gpus_per_node < 0:
        raise UserError(
            f"--nodes {nodes} --gpus-per-node {gpus_per_node}: take 1 node or more and no negative count"
        )
    settings = _Settings(options, nodes, gpus_per_node)
    groups: list[Group] = []
    for need, stages in _cut(recipe, gpus_per_node):
        for one in [] if groups else _parts_of(stages, parts):
            name = f"{len(groups) + 1}-{_label(one.stage)}-{one.step}"
            groups.append(settings.group(name, "cpu", (one.stage,), groups, one))
        names = tuple(stage.name for stage in stages)
        read = {name for stage in stages for name in stage.inputs.values()}
        last = tuple(name for name in names if name not in read)
        label = "train" if any(stage.kind.trains for stage in stages) else _label(names[0])
        groups.append(settings.group(f"{len(groups) + 1}-{label}", need, names, groups, last=last))
    _require_fit(recipe, groups)
    word = options.name or _word(recipe.name)[:30].strip("-")
    name = word if word[:1].isalpha() else f"run-{word}"
    return LaunchPlan(name, recipe, given, tuple(overrides), str(out), tuple(groups))


@dataclass(frozen=True)
class _Settings:
    options: LaunchOptions
    nodes: int
    gpus: int

    def group(
        self,
        name: str,
        need: Need,
        stages: tuple[str, ...],
        before: Sequence[Group],
        parts: Parts | None = None,
        last: tuple[str, ...] = (),
    ) -> Group:
        after = before[-1].name if before else None
        return Group(name, need, stages, last, self._machines(need), self._hardware(need), after, parts)

    def _machines(self, need: Need) -> Machines:
        options = self.options
        if need != "all":
            gpus = int(need == "gpu")
            cpus, memory = options.light_cpus, options.light_memory_gb
            return Machines(1, 1, gpus, cpus, memory, options.light_minutes)
        each = max(self.gpus, 1)
        cpus, memory = options.cpus_per_gpu * each, options.memory_gb_per_gpu * each
        return Machines(self.nodes, each, self.gpus, cpus, memory, options.time_minutes)

    def _hardware(self, need: Need) -> tuple[str, ...]:
        nodes, devices = (self.nodes, max(self.gpus, 1)) if need == "all" else (1, 1)
        fields = [f"nodes={nodes}", f"devices={devices}"]
        if need != "all":
            fields.append(f"convert_workers={self.options.light_cpus}")
        if need == "cpu" or self.gpus == 0:
            fields.append("accelerator=cpu")
        return tuple(f"hardware.{field}" for field in fields)


def _cut(recipe: Recipe, gpus: int) -> list[tuple[Need, list[Stage]]]:
    """Runs of stages that need the same, in an order that can run.

    A stage is put forward into an earlier group where all that it reads is there: every group waits in the
    engine's queue once.
    """
    needs = _needs(recipe, gpus)
    waiting = list(recipe.stages)
    done: set[str] = set()
    out: list[tuple[Need, list[Stage]]] = []
    while waiting:
        ready = [stage for stage in waiting if done.issuperset(stage.inputs.values())]
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


def _parts_of(stages: Sequence[Stage], count: int) -> list[Parts]:
    """The conversions among the stages as parts: the steps of all that come first, then the shards."""
    if count == 1:
        return []
    found = [stage for stage in stages if isinstance(stage.kind, ConvertStage)]
    first = [stage for stage in found if converter_named(stage.kind.name).features_first]
    return [
        *(Parts(stage.name, "features", count) for stage in first),
        *(Parts(stage.name, "shards", count) for stage in found),
    ]


def _require_fit(recipe: Recipe, groups: Sequence[Group]) -> None:
    """Refuse before anything waits in a queue what its group's processes could not run."""
    for group in groups:
        hardware = recipe.hardware.model_copy(
            # What is installed here says nothing of the cluster, so loggers are not asked after.
            update={"nodes": group.machines.nodes, "devices": group.machines.processes, "loggers": ()}
        )
        for name in group.stages:
            try:
                recipe.stage(name).config.require_fit(hardware)
            except UserError as error:
                raise UserError(f"stage {name}: {error}") from None


def _label(stage: str) -> str:
    return _word(stage)[:12].strip("-")


def _word(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def _say_machines(group: Group) -> str:
    machines = group.machines
    if group.need == "all" and machines.gpus:
        return f"{machines.nodes} x {machines.gpus} GPUs"
    if group.need == "all":
        return f"{machines.nodes} x 1 process"
    return f"{machines.cpus} cores" + (", 1 GPU" if machines.gpus else "")
