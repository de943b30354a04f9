"""`motionloom launch --on kubernetes`: a recipe as one JobSet, an Indexed Job for each group.

- `dependsOn`: a group is created when those that it reads are complete.
- A group whose processes a signal has ended (exit code 75), or whose node was taken away, is created again
  as often as that happens. A user's mistake (2) fails all at once. After any other end the group is created
  again, at most `restarts` times in all. What is done is skipped, so nothing is made twice.
- Parts of a conversion need no one else, so each is tried again alone.
- The resolved recipe is a ConfigMap. Kueue admits the JobSet where a queue is named.
"""

from __future__ import annotations

import shlex
from typing import Any

from motionloom.pipeline.launch.cluster import WARN_SECONDS, ClusterOptions
from motionloom.pipeline.launch.process import SAVED
from motionloom.pipeline.runs.cluster.launch_plan import Group, LaunchPlan
from motionloom.pipeline.store.yaml import dump_yaml

_RECIPE = "/etc/motionloom/recipe.yaml"
_LANES = 5
"""Groups that JobSet lets one wait for. Who reads more waits for the last five, each of which waits for the
one five places before it, and so on."""


def manifest(plan: LaunchPlan, options: ClusterOptions) -> str:
    """The ConfigMap and the JobSet of a plan, as `kubectl apply` takes them."""
    metadata: dict[str, Any] = {"name": plan.name}
    recipe = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": dict(metadata)}
    recipe["data"] = {"recipe.yaml": plan.recipe.to_yaml()}
    if options.queue:
        metadata["labels"] = {"kueue.x-k8s.io/queue-name": options.queue}
    rules: list[dict[str, Any]] = [
        {"name": "mistake", "action": "FailJobSet", "onJobFailureMessagePatterns": ["exit code 2 "]},
        {"name": "saved", "action": "RestartJobAndIgnoreMaxRestarts"},
        {"name": "other", "action": "RestartJob"},
    ]
    for rule in rules[:2]:
        rule["onJobFailureReasons"] = ["PodFailurePolicy"]
    before = {group.name: set(group.after) for group in plan.groups}
    order = [*before]
    for name in reversed(order):  # whom it lets wait for more comes later in this loop
        read = sorted(before[name], key=order.index)
        before[name] = set(read[-_LANES:])
        for early, late in zip(read, read[_LANES:], strict=False):
            before[late].add(early)
    spec = {
        "network": {"enableDNSHostnames": True, "subdomain": plan.name},
        "failurePolicy": {"maxRestarts": options.restarts, "rules": rules},
        "replicatedJobs": [_job(plan, group, options, before[group.name]) for group in plan.groups],
    }
    jobs = {"apiVersion": "jobset.x-k8s.io/v1alpha2", "kind": "JobSet", "metadata": metadata, "spec": spec}
    return dump_yaml(recipe) + "---\n" + dump_yaml(jobs)


def _job(plan: LaunchPlan, group: Group, options: ClusterOptions, before: set[str]) -> dict[str, Any]:
    parts, pods = group.parts > 1, group.parts * group.machines.nodes
    codes = {"onExitCodes": {"operator": "In", "values": [2] if parts else [2, SAVED]}}
    taken = {"onPodConditions": [{"type": "DisruptionTarget"}]}
    rules: list[dict[str, Any]] = [{"action": "FailJob", **codes}]
    if parts:
        rules += [{"action": "Ignore", "onExitCodes": {"operator": "In", "values": [SAVED]}}]
    rules += [{"action": "Ignore" if parts else "FailJob", **taken}]
    spec = {
        "completionMode": "Indexed",
        "completions": pods,
        "parallelism": pods,
        **({"backoffLimitPerIndex": options.restarts} if parts else {"backoffLimit": 0}),
        "podFailurePolicy": {"rules": rules},
        "template": {"spec": _pod(plan, group, options)},
    }
    waits = [{"name": name, "status": "Complete"} for name in sorted(before)]
    return {"name": group.name, **({"dependsOn": waits} if waits else {}), "template": {"spec": spec}}


def _pod(plan: LaunchPlan, group: Group, options: ClusterOptions) -> dict[str, Any]:
    machines, (image, volume) = group.machines, options.require_given("image", "volume")
    memory = f"{round(options.memory_gb * machines.processes * 1024)}Mi"
    limits = {"memory": memory} | ({options.gpu_resource: str(machines.gpus)} if machines.gpus else {})
    command = plan.command(group, _RECIPE, ["motionloom"])
    if group.parts > 1:
        part = f"hardware.part=$((JOB_COMPLETION_INDEX + 1))/{group.parts}"
        command = ["sh", "-c", f"exec {shlex.join(command)} --set {part}"]
    env = [{"name": "HOME", "value": options.mount}]
    if machines.nodes > 1:  # the Job says which node each is (JOB_COMPLETION_INDEX)
        first = f"{plan.job(group)}-0-0.{plan.name}"
        env.append({"name": "MASTER_ADDR", "value": first})
    container = {
        "name": "motionloom",
        "image": image,
        "workingDir": options.mount,
        "command": command,
        "env": env,
        "resources": {
            "requests": {"cpu": str(options.cpus * machines.processes), "memory": memory},
            "limits": limits,
        },
        "volumeMounts": [
            {"name": "data", "mountPath": options.mount},
            {"name": "recipe", "mountPath": "/etc/motionloom"},
            {"name": "shared-memory", "mountPath": "/dev/shm"},
        ],
    }
    return {
        "restartPolicy": "Never",
        "terminationGracePeriodSeconds": WARN_SECONDS,
        # All write the same files.
        "securityContext": {"runAsNonRoot": True, "runAsUser": 1000, "runAsGroup": 1000, "fsGroup": 1000},
        "containers": [container],
        "volumes": [
            {"name": "data", "persistentVolumeClaim": {"claimName": volume}},
            {"name": "recipe", "configMap": {"name": plan.name}},
            {"name": "shared-memory", "emptyDir": {"medium": "Memory"}},
        ],
    }
