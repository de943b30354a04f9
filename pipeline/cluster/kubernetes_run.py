"""A launch plan on Kubernetes: one YAML file of plain objects, applied with kubectl.

- A group is a `batch/v1` Job; the parts of a conversion are an Indexed Job. A group of several nodes is a
  `TrainJob` of Kubeflow Trainer 2.2 or later, whose runtime tells torchrun the nodes by its PET_ variables.
- Kubernetes starts all that is applied. So every group but the first is suspended: it has no pods and takes
  no GPU. Two kubectl commands a group wait for the one before and resume the next (`kubernetes_steps`). A pod
  that waits for a marker of the group before would be simpler to start, and would occupy its GPUs meanwhile.
- The run folder lies in a PersistentVolumeClaim that all groups mount. All containers have one user, because
  they write the same files; Kubeflow's runtime refuses root.
- No command passes through a shell. Kubernetes itself expands `$(NAME)` in commands, so dollars are doubled.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Any

from motionloom.datasets.schema import UserError
from motionloom.pipeline.cluster.plan import Group, LaunchPlan
from motionloom.pipeline.launch.options import KubernetesOptions
from motionloom.pipeline.store.yaml import dump_yaml

_CONTAINER = "node"
"""Also what Kubeflow's runtimes call theirs."""

_RECIPE_FOLDER = PurePosixPath("/etc/motionloom")
_RECIPE_FILE = "recipe.yaml"


def kubernetes_objects(plan: LaunchPlan, options: KubernetesOptions) -> list[dict[str, Any]]:
    """The objects of a plan, in the order of its groups; a recipe of the user's own comes first."""
    if not PurePosixPath(plan.out).is_relative_to(options.mount):
        raise UserError(
            f"--out {plan.out}: would vanish with its pod; take a folder below {options.mount}, where the "
            f"claim is mounted, or set --cluster mount=FOLDER"
        )
    made = [_recipe(plan, options)] if plan.given is None else []
    for group in plan.groups:
        several = group.machines.nodes > 1
        made.append(_train_job(plan, group, options) if several else _job(plan, group, options))
    return made


def kubernetes_yaml(plan: LaunchPlan, options: KubernetesOptions) -> str:
    """The objects as one file of several documents."""
    return "---\n".join(dump_yaml(made) for made in kubernetes_objects(plan, options))


def kubernetes_steps(plan: LaunchPlan, options: KubernetesOptions, file: str) -> list[str]:
    """The kubectl commands that run the groups one after the other; a shell may run them as they are."""
    where = [] if options.namespace is None else ["--namespace", options.namespace]
    steps = [["kubectl", "apply", *where, "--filename", file]]
    resume = ["--type=merge", "--patch", '{"spec":{"suspend":false}}']
    for number, group in enumerate(plan.groups):
        kind, done = ("trainjob", "Complete") if group.machines.nodes > 1 else ("job", "complete")
        name = f"{kind}/{plan.job(group)}"
        if number:
            steps.append(["kubectl", "patch", *where, name, *resume])
        limit = f"--timeout={group.machines.minutes}m"
        steps.append(["kubectl", "wait", *where, f"--for=condition={done}", limit, name])
    return [shlex.join(words) for words in steps]


def _metadata(plan: LaunchPlan, options: KubernetesOptions, name: str, component: str) -> dict[str, Any]:
    labels = _labels(plan, component)
    where = {} if options.namespace is None else {"namespace": options.namespace}
    return {"name": name, **where, "labels": labels}


def _labels(plan: LaunchPlan, component: str) -> dict[str, str]:
    return {
        "app.kubernetes.io/name": "motionloom",
        "app.kubernetes.io/instance": plan.name,
        "app.kubernetes.io/component": component,
    }


def _recipe(plan: LaunchPlan, options: KubernetesOptions) -> dict[str, Any]:
    return {
        "apiVersion": "v1",
        "kind": "ConfigMap",
        "metadata": _metadata(plan, options, f"{plan.name}-recipe", "recipe"),
        "data": {_RECIPE_FILE: plan.recipe.to_yaml()},
    }


def _job(plan: LaunchPlan, group: Group, options: KubernetesOptions) -> dict[str, Any]:
    parts = group.parts
    # An eviction is no failure of the pod's.
    evicted = {"action": "Ignore", "onPodConditions": [{"type": "DisruptionTarget", "status": "True"}]}
    spec: dict[str, Any] = {
        "suspend": group.after is not None,
        "backoffLimit": options.retries,
        "activeDeadlineSeconds": 60 * group.machines.minutes,
        "podFailurePolicy": {"rules": [evicted]},
    }
    if parts is not None:
        spec |= {"completionMode": "Indexed", "completions": parts.count, "parallelism": parts.count}
    container = {
        "name": _CONTAINER,
        "image": options.image,
        "command": _escaped(_command(plan, group, options)),
        "env": _environment(group, options),
        "resources": _resources(group, options),
        "volumeMounts": _mounts(plan, group, options),
    }
    spec["template"] = {
        "metadata": {"labels": _labels(plan, group.name)},
        "spec": {
            "restartPolicy": "Never",
            "securityContext": _security(options),
            "containers": [container],
            "volumes": _volumes(plan, group, options),
        },
    }
    return {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": _metadata(plan, options, plan.job(group), group.name),
        "spec": spec,
    }


def _train_job(plan: LaunchPlan, group: Group, options: KubernetesOptions) -> dict[str, Any]:
    pod = {
        "securityContext": _security(options),
        "volumes": _volumes(plan, group, options),
        "containers": [{"name": _CONTAINER, "volumeMounts": _mounts(plan, group, options)}],
    }
    node = {"name": _CONTAINER, "template": {"spec": {"template": {"spec": pod}}}}
    patch = {
        "manager": "motionloom",
        "trainingRuntimeSpec": {"template": {"spec": {"replicatedJobs": [node]}}},
    }
    return {
        "apiVersion": "trainer.kubeflow.org/v1alpha1",
        "kind": "TrainJob",
        "metadata": _metadata(plan, options, plan.job(group), group.name),
        "spec": {
            "suspend": group.after is not None,
            "activeDeadlineSeconds": 60 * group.machines.minutes,
            "runtimeRef": {"name": options.runtime},
            "trainer": {
                "image": options.image,
                "numNodes": group.machines.nodes,
                "numProcPerNode": group.machines.processes,
                "command": _escaped(_command(plan, group, options)),
                "env": _environment(group, options),
                "resourcesPerNode": _resources(group, options),
            },
            "runtimePatches": [patch],
        },
    }


def _command(plan: LaunchPlan, group: Group, options: KubernetesOptions) -> list[str]:
    """What a pod runs, in the folder of the claim: a TrainJob has no field for the working directory."""
    machines, recipe = group.machines, str(_RECIPE_FOLDER / _RECIPE_FILE)
    there = ["env", f"--chdir={options.mount}"]
    if group.parts is not None:
        return [*there, *plan.part_command(group.parts, recipe, ["python", "-P"])]
    command = plan.command(group, recipe, ["motionloom"])
    if machines.nodes > 1:
        return [*there, "torchrun", "--no-python", *command]
    if machines.processes > 1:
        alone = ["--standalone", f"--nproc-per-node={machines.processes}"]
        return [*there, "torchrun", *alone, "--no-python", *command]
    return [*there, *command]


def _escaped(words: Sequence[str]) -> list[str]:
    return [word.replace("$", "$$") for word in words]


def _environment(group: Group, options: KubernetesOptions) -> list[dict[str, str]]:
    # The user has no home in the image; what is downloaded is kept with the data.
    found = [{"name": "HOME", "value": str(options.mount).replace("$", "$$")}]
    if group.parts is not None:
        found.append({"name": "MOTIONLOOM_WORKERS", "value": str(group.machines.cpus)})
    return found


def _resources(group: Group, options: KubernetesOptions) -> dict[str, Any]:
    machines = group.machines
    asked = {"cpu": str(machines.cpus), "memory": f"{machines.memory_mib}Mi"}
    gpus = {options.gpu_resource: str(machines.gpus)} if machines.gpus else {}
    return {"requests": {**asked, **gpus}, "limits": {"memory": asked["memory"], **gpus}}


def _security(options: KubernetesOptions) -> dict[str, Any]:
    user = options.user
    return {"runAsNonRoot": True, "runAsUser": user, "runAsGroup": user, "fsGroup": user}


def _volumes(plan: LaunchPlan, group: Group, options: KubernetesOptions) -> list[dict[str, Any]]:
    made: list[dict[str, Any]] = [
        {"name": "runs", "persistentVolumeClaim": {"claimName": options.claim}},
    ]
    if group.need == "all":  # NCCL and loader workers pass more through it than a container's 64 MB
        made.append({"name": "shared-memory", "emptyDir": {"medium": "Memory"}})
    if plan.given is None:
        made.append({"name": "recipe", "configMap": {"name": f"{plan.name}-recipe"}})
    return made


def _mounts(plan: LaunchPlan, group: Group, options: KubernetesOptions) -> list[dict[str, Any]]:
    made: list[dict[str, Any]] = [{"name": "runs", "mountPath": str(options.mount)}]
    if group.need == "all":
        made.append({"name": "shared-memory", "mountPath": "/dev/shm"})
    if plan.given is None:
        made.append({"name": "recipe", "mountPath": str(_RECIPE_FOLDER), "readOnly": True})
    return made
