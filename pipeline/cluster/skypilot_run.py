"""A launch plan with SkyPilot: one YAML file, a chain of tasks for `sky jobs launch`.

- The first document names the chain, the others are the groups; SkyPilot starts a task when the one before
  has succeeded, on machines of its own, and starts it again where machines are withdrawn.
- So the run folder must outlive the machines: in a SkyPilot volume or a bucket. Machines write to a bucket
  through a cache of their own, and processes on several nodes would not see each other's files in time:
  several nodes need a volume.
- What SkyPilot tells each node (its rank, the addresses) goes to torchrun; the user's words are quoted.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path, PurePosixPath
from typing import Any

from motionloom.datasets.schema import UserError
from motionloom.pipeline.cluster.plan import Group, LaunchPlan
from motionloom.pipeline.launch.options import SkyPilotOptions
from motionloom.pipeline.store.yaml import dump_yaml

_RECIPE = PurePosixPath("/tmp/motionloom-recipe.yaml")
"""Where the resolved recipe is copied to on a machine."""

_TORCHRUN = """\
torchrun --nnodes "$SKYPILOT_NUM_NODES" --node-rank "$SKYPILOT_NODE_RANK" --nproc-per-node {processes} \\
  --master-addr "$(echo "$SKYPILOT_NODE_IPS" | head -n 1)" --master-port 29500 --no-python \\
  {command}
"""


def skypilot_tasks(plan: LaunchPlan, options: SkyPilotOptions, recipe: Path | None) -> list[dict[str, Any]]:
    """The documents of a plan; `recipe` is the file here with the resolved recipe of the user's own."""
    _require_place(plan, options)
    return [{"name": plan.name}, *(_task(plan, group, options, recipe) for group in plan.groups)]


def skypilot_yaml(plan: LaunchPlan, options: SkyPilotOptions, recipe: Path | None) -> str:
    """The tasks as one file of several documents."""
    return "---\n".join(dump_yaml(task) for task in skypilot_tasks(plan, options, recipe))


def skypilot_steps(plan: LaunchPlan, file: str) -> list[str]:
    """The command that starts the chain."""
    return [shlex.join(["sky", "jobs", "launch", "--name", plan.name, file])]


def _require_place(plan: LaunchPlan, options: SkyPilotOptions) -> None:
    if options.accelerator is None and any(group.machines.gpus for group in plan.groups):
        raise UserError(
            "SkyPilot wants to know which GPUs: give --cluster accelerator=H100 or the like, or "
            "--gpus-per-node 0"
        )
    if _is_bucket(options) and any(group.machines.nodes > 1 for group in plan.groups):
        raise UserError(
            f"--cluster storage={options.storage}: processes on several nodes do not see each other's files "
            f"in a bucket in time; name a SkyPilot volume (sky volumes apply), or take --nodes 1"
        )
    if not PurePosixPath(plan.out).is_relative_to(options.mount):
        raise UserError(
            f"--out {plan.out}: would vanish with its machine; take a folder below {options.mount}, where "
            f"the storage is mounted, or set --cluster mount=FOLDER"
        )
    if options.image is None and options.workdir is None and options.setup is None:
        raise UserError(
            "SkyPilot's machines come without motionloom: give --cluster image=IMAGE, --cluster "
            "workdir=CHECKOUT or --cluster setup='pip install ...'"
        )


def _is_bucket(options: SkyPilotOptions) -> bool:
    return re.match(r"[a-z0-9]+://", options.storage) is not None


def _task(plan: LaunchPlan, group: Group, options: SkyPilotOptions, recipe: Path | None) -> dict[str, Any]:
    machines = group.machines
    resources: dict[str, Any] = {
        "infra": options.infra,
        "cpus": f"{machines.cpus}+",
        "memory": f"{machines.memory_gb:g}+",
        "accelerators": {options.accelerator: machines.gpus} if machines.gpus else None,
        "image_id": f"docker:{options.image}" if options.image else None,
        "use_spot": True if options.use_spot else None,
    }
    mount = str(options.mount)
    mounts: dict[str, Any] = {}
    if _is_bucket(options):
        mounts[mount] = {"source": options.storage, "mode": "MOUNT_CACHED"}
    if recipe is not None:
        mounts[str(_RECIPE)] = str(recipe)
    setup = options.setup or ("pip install ." if options.workdir else None)
    task: dict[str, Any] = {
        "name": plan.job(group),
        "workdir": str(options.workdir.expanduser().absolute()) if options.workdir else None,
        "num_nodes": machines.nodes,
        "resources": {key: value for key, value in resources.items() if value is not None},
        "volumes": None if _is_bucket(options) else {mount: options.storage},
        "file_mounts": mounts or None,
        "setup": setup,
        "run": _run(plan, group, options),
    }
    return {key: value for key, value in task.items() if value is not None}


def _run(plan: LaunchPlan, group: Group, options: SkyPilotOptions) -> str:
    command = shlex.join(plan.command(group, str(_RECIPE), ["motionloom"]))
    machines = group.machines
    if machines.nodes * machines.processes > 1:
        command = _TORCHRUN.format(processes=machines.processes, command=command).rstrip()
    return f"cd {shlex.quote(str(options.mount))}\n{command}\n"
