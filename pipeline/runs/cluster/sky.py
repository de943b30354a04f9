"""`motionloom launch --on sky`: a recipe as a pipeline of SkyPilot's managed jobs, a task for each group.

Its tasks run one after the other. A machine that is taken away is found again by SkyPilot; a training that a
signal has ended (exit code 75) goes on, other ends are tried again at most `restarts` times.
"""

from __future__ import annotations

import shlex
from typing import Any

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.launch.cluster import ClusterOptions
from motionloom.pipeline.launch.process import SAVED
from motionloom.pipeline.runs.cluster.launch_plan import Group, LaunchPlan
from motionloom.pipeline.store.yaml import dump_yaml

_RECIPE = "/tmp/motionloom.yaml"


def pipeline(plan: LaunchPlan, options: ClusterOptions) -> str:
    """The tasks of a plan, as `sky jobs launch` takes them."""
    return "---\n".join(
        dump_yaml(one)
        for one in ({"name": plan.name}, *(_task(plan, group, options) for group in plan.groups))
    )


def _task(plan: LaunchPlan, group: Group, options: ClusterOptions) -> dict[str, Any]:
    machines = group.machines
    nodes = group.machines.nodes * group.parts
    if options.bucket and nodes > 1:  # machines would see each other's files too late
        raise UserError(f"group {group.name} needs {nodes} machines, and a bucket serves one: give a volume")
    resources: dict[str, Any] = {
        "image_id": f"docker:{options.require_given('image')[0]}",
        "cpus": f"{options.cpus * machines.processes}+",
        "memory": f"{round(options.memory_gb * machines.processes)}+",
        "use_spot": options.spot,
        "job_recovery": {"max_restarts_on_errors": options.restarts, "recover_on_exit_codes": [SAVED]},
    }
    if machines.gpus:
        resources["accelerators"] = {options.gpu: machines.gpus}
    if options.infra:
        resources["infra"] = options.infra
    place: dict[str, Any]
    if options.bucket:
        place = {"file_mounts": {options.mount: {"source": options.bucket, "mode": "MOUNT_CACHED"}}}
    else:
        place = {"volumes": {options.mount: options.require_given("volume")[0]}}
    command = shlex.join(plan.command(group, _RECIPE, ["motionloom"]))
    if group.parts > 1:
        command += f" --set hardware.part=$((SKYPILOT_NODE_RANK + 1))/{group.parts}"
    write = f'printf %s "$MOTIONLOOM_RECIPE" > {_RECIPE}'
    return {
        "name": group.name,
        "num_nodes": nodes,
        "resources": resources,
        **place,
        "envs": {"MOTIONLOOM_RECIPE": plan.recipe.to_yaml()},
        "run": f"{write}\ncd {shlex.quote(options.mount)}\nexec {command}\n",
    }
