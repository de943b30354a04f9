"""The processes of one run: who leads, how the others join and wait for it.

The lead (rank 0) runs every stage and is the only one that writes; the others take part in training stages.
They start together, before anything is written, so all of them see the same plan. Processes come from
Lightning's launcher (which repeats the command) or from torchrun or SLURM.
"""

from __future__ import annotations

import hashlib
import os
import platform
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import timedelta
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, cast

import torch
import torch.distributed as dist
from torch._C._distributed_c10d import TCPStore

from motionloom import datasets, models, pipeline
from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.launch.process import JointError, TeamError, members, srun_tasks, started

if TYPE_CHECKING:
    from lightning.fabric.plugins.environments.cluster_environment import ClusterEnvironment

Found = TypeVar("Found")

_PATIENCE = timedelta(days=30)
"""Longest wait of the other ranks for a stage that only the lead runs; a dead lead ends it at once."""

_COLLECTIVE = 1800
"""Seconds for which a process waits for the others, at least. A training that stalls ends itself earlier,
after `hardware.stall_seconds` without a step; this ends what waits for a process that cannot do so."""


_GRACE = 60
"""Seconds between two looks of Lightning's observer, which kills the lead where another process has died. A
lead that can end by itself finishes the checkpoint that it writes and says what happened before that."""


@dataclass(frozen=True)
class Team:
    """All processes of a run."""

    rank: int = 0
    world: int = 1
    waiting: dist.ProcessGroup | None = None
    """A group of its own, because the training group's collectives must fail early and waiting must not."""

    @staticmethod
    def start(hardware: Hardware, facts: Mapping[str, object] | None = None) -> Team:
        """Launch the other processes, or join them where a launcher has; returns when all are here, and have
        the same `facts`."""
        from lightning.fabric import Fabric
        from lightning.fabric.strategies.ddp import DDPStrategy

        _require_match(hardware)  # a launcher that disagrees would have processes wait for ever
        if hardware.world() == 1:
            return Team()
        _meet_nodes(hardware)
        launcher = environment()
        fabric = Fabric(
            accelerator=hardware.lightning_accelerator(),
            devices=hardware.resolved_devices(),
            num_nodes=hardware.nodes,
            strategy=DDPStrategy(
                process_group_backend=hardware.backend(),
                timeout=timedelta(seconds=max(_COLLECTIVE, 2 * hardware.stall_seconds)),
            ),
            plugins=[launcher] if launcher else None,
        )
        fabric.launch()
        started.extend(getattr(fabric.strategy.launcher, "procs", ()))
        give_time()
        team = Team(fabric.global_rank, fabric.world_size, _patient_group())
        team.agree({**_versions(), **(facts or {})})
        members[:] = team.gather(f"process {os.getpid()} on {platform.node()}")
        return team

    @property
    def leads(self) -> bool:
        return self.rank == 0

    def agree(self, facts: Mapping[str, object]) -> None:
        """Refuse ranks that would compute something else, by the first of the facts that differs.

        Two seeds train a model that no recipe makes again, and two numbers of steps wait for ever.
        """
        lead, *others = self.gather(facts)  # some 20 kB of each
        for rank, other in enumerate(others, start=1):
            for key in (key for key in (*lead, *other) if lead.get(key, _NONE) != other.get(key, _NONE)):
                raise JointError(
                    f"rank {rank} differs from rank 0 in {key}: {other.get(key, _NONE)} there, "
                    f"{lead.get(key, _NONE)} here; start all ranks with the same command, files and versions"
                )

    def meet(self) -> None:
        if self.waiting is None:
            return
        try:
            dist.barrier(self.waiting)
        except RuntimeError:
            raise TeamError.lost() from None

    def gather(self, mine: Found) -> list[Found]:
        """Return in every process the values of all, in the order of their ranks."""
        if self.waiting is None:
            return [mine]
        values = [mine] * self.world
        try:
            dist.all_gather_object(values, mine, self.waiting)
        except RuntimeError:
            raise TeamError.lost() from None
        return values


_NONE = "(nothing)"


def _versions() -> dict[str, str]:
    """Versions that all ranks must have alike; ours with a digest: a checkout changes under its version."""
    code = hashlib.sha256()
    for package in (datasets, models, pipeline):
        for path in sorted(Path(package.__path__[0]).rglob("*.py")):
            code.update(path.read_bytes())
    ours = f"{metadata.version('motionloom')} (code {code.hexdigest()[:12]})"
    return {"motionloom": ours, "torch": torch.__version__}


def give_time() -> None:
    """Have Lightning's observer of other processes look every `_GRACE` seconds."""
    for thread in threading.enumerate():
        if thread.name == "child-process-observer":
            thread._sleep_period = _GRACE  # type: ignore[attr-defined]


def lead_finds(find: Callable[[], Found]) -> Found:
    """Return in every process what `find` returns in the lead.

    Files on a shared file system may look different to two nodes for a moment, and one process is enough to
    read gigabytes. Where no processes have met yet, each finds for itself.
    """
    if not dist.is_initialized() or dist.get_world_size() == 1:
        return find()
    try:
        result = [find() if dist.get_rank() == 0 else None]
        dist.broadcast_object_list(result, src=0, group=_patient_group())
    except RuntimeError as error:
        if "by peer" in str(error):
            raise TeamError.lost() from None
        raise
    return cast(Found, result[0])


@cache
def _patient_group() -> dist.ProcessGroup:
    """Made once: every group is a connection of all with all, which may fail where a machine is busy."""
    return cast(dist.ProcessGroup, dist.new_group(backend="gloo", timeout=_PATIENCE))


def _meet_nodes(hardware: Hardware) -> None:
    """Refuse nodes that count other processes than the first, which no launcher has compared: they would wait
    for each other until the time-out."""
    env = os.environ
    nodes = hardware.nodes
    if nodes == 1 or env.keys() & {"RANK", "LOCAL_RANK"} or srun_tasks() > 1:
        return
    node = int(env["NODE_RANK"])
    mine = f"{nodes} and hardware.devices {hardware.resolved_devices()}"
    try:
        store = _node_store(env["MASTER_ADDR"], int(env["MASTER_PORT"]), node == 0)
        store.set(f"node/{node}", mine)
        counts = [store.get(f"node/{other}").decode() for other in range(nodes)]
    except RuntimeError:  # the first node has ended, or never came
        raise TeamError.lost() from None
    for other, count in enumerate(counts):
        if count != counts[0]:
            raise UserError(
                f"node {other} has hardware.nodes {count}, node 0 {counts[0]}; start all with one command"
            )


@cache
def _node_store(address: str, port: int, first: bool) -> TCPStore:
    """Made once, as long as the process lives: torch makes its own on the same server."""
    patience = timedelta(seconds=_COLLECTIVE)
    return TCPStore(address, port, None, first, patience, wait_for_workers=False, multi_tenant=True)


def environment() -> ClusterEnvironment | None:
    """Who started this process, where Lightning would be mistaken under SLURM.

    It goes by the job's name and SLURM_NTASKS: it takes a batch script for a task of srun, and waits for the
    others; and tasks of an srun inside `salloc` for lone processes, which each start all again. Its own
    requeueing is off: its checkpoint in the current folder would be taken up by any stage that trains there
    next. Runs resume by themselves.
    """
    from lightning.fabric.plugins.environments.lightning import LightningEnvironment
    from lightning.fabric.plugins.environments.slurm import SLURMEnvironment

    if "RANK" in os.environ or "SLURM_NTASKS" not in os.environ:
        return None
    return SLURMEnvironment(auto_requeue=False) if srun_tasks() > 1 else LightningEnvironment()


def _require_match(hardware: Hardware) -> None:
    """Refuse to train in processes that do not know of each other: each would write the same files."""
    world = hardware.world()
    devices = hardware.resolved_devices()
    nodes = hardware.nodes
    env = os.environ
    tasks = srun_tasks()
    fix = "set hardware.devices (processes on a node) and hardware.nodes to match it"
    if "RANK" in env:
        launched = env.get("WORLD_SIZE", str(world))
        if int(launched) != world:
            raise UserError(
                f"the launcher started {launched} processes and the recipe asks for {world}: {fix}"
            )
        restarts = env.get("TORCHELASTIC_MAX_RESTARTS", "0") != "0"
        if world > 1 and restarts and env.get("TORCHELASTIC_USE_AGENT_STORE") == "True":
            raise UserError(
                "torchrun would have restarted processes look for those that died: start it with "
                "TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1 in its environment and --rdzv-backend=c10d, or with "
                "--max-restarts=0"
            )
        return
    # Without srun one process starts the others on its own machine, and knows none elsewhere.
    start = f"start it with srun --nodes {nodes} --ntasks-per-node {devices}"
    if tasks == 1:
        node = env.get("NODE_RANK", "0" if nodes == 1 else "")
        if "SLURM_JOB_ID" in env and not node:
            raise UserError(f"hardware.nodes is {nodes} and this process is alone in its SLURM job: {start}")
        if not node.isdecimal() or int(node) >= nodes or (nodes > 1 and "MASTER_ADDR" not in env):
            raise UserError(
                f"hardware.nodes is {nodes}, NODE_RANK {node or 'not set'} and MASTER_ADDR "
                f"{env.get('MASTER_ADDR', 'not set')}: give each node its number from 0 and the address of "
                f"node 0"
            )
        return
    each = env.get("SLURM_NTASKS_PER_NODE")
    stated_nodes = env.get("SLURM_NNODES", str(nodes))
    if tasks != world or (each or str(devices)) != str(devices) or stated_nodes != str(nodes):
        raise UserError(
            f"srun started {tasks} processes on {stated_nodes} node(s) and the recipe asks for {devices} on "
            f"{nodes}: {fix}, and give each process all GPUs of its node (--gpus-per-node, not "
            f"--gpus-per-task)"
        )
    if each is None:  # Lightning needs it to number the processes of a node
        raise UserError(f"srun started {tasks} processes without saying how many on a node: {start}")
