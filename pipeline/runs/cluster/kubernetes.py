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

import yaml

from motionloom.pipeline.launch.cluster import ClusterOptions
from motionloom.pipeline.runs.cluster.launch_plan import Group, LaunchPlan
from motionloom.pipeline.store.yaml import dump_yaml

_LANES = 5
"""Groups that JobSet lets one wait for. Who reads more waits for the last five, each of which waits for the
one five places before it, and so on."""

_JOBSET = """
apiVersion: jobset.x-k8s.io/v1alpha2
kind: JobSet
metadata: {labels: {}}
spec:
  network: {enableDNSHostnames: true}
  failurePolicy:
    rules:
    - name: mistake
      action: FailJobSet
      onJobFailureReasons: [PodFailurePolicy]
      onJobFailureMessagePatterns: ["exit code 2 "]
    - {name: saved, action: RestartJobAndIgnoreMaxRestarts, onJobFailureReasons: [PodFailurePolicy]}
    - {name: other, action: RestartJob}
"""
"""With the action for each end, see above: Kubernetes tells JobSet the exit code in the Job's message."""
_TOGETHER = """
completionMode: Indexed
backoffLimit: 0
podFailurePolicy:
  rules:
  - {action: FailJob, onExitCodes: {operator: In, values: [2, 75]}}
  - {action: FailJob, onPodConditions: [{type: DisruptionTarget}]}
"""
"""A group whose processes train together, and ends with the first of them."""
_IN_PARTS = """
completionMode: Indexed
podFailurePolicy:
  rules:
  - {action: FailJob, onExitCodes: {operator: In, values: [2]}}
  - {action: Ignore, onExitCodes: {operator: In, values: [75]}}
  - {action: Ignore, onPodConditions: [{type: DisruptionTarget}]}
"""
"""Each part alone."""
_POD = """
restartPolicy: Never
terminationGracePeriodSeconds: 120
securityContext: {runAsNonRoot: true, runAsUser: 1000, runAsGroup: 1000, fsGroup: 1000}
volumes:
- {name: data}
- {name: recipe}
- {name: shared-memory, emptyDir: {medium: Memory}}
"""
"""One user, as all write the same files."""
_MOUNTS = """
- {name: data}
- {name: recipe, mountPath: /etc/motionloom}
- {name: shared-memory, mountPath: /dev/shm}
"""


def manifest(plan: LaunchPlan, options: ClusterOptions) -> str:
    """The ConfigMap and the JobSet of a plan, as `kubectl apply` takes them."""
    recipe = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": plan.name}}
    recipe["data"] = {"recipe.yaml": plan.recipe.to_yaml()}
    jobs = yaml.safe_load(_JOBSET)
    jobs["metadata"]["name"] = jobs["spec"]["network"]["subdomain"] = plan.name
    if options.queue:
        jobs["metadata"]["labels"]["kueue.x-k8s.io/queue-name"] = options.queue
    jobs["spec"]["failurePolicy"]["maxRestarts"] = options.restarts
    before = {group.name: set(group.after) for group in plan.groups}
    order = [*before]
    for name in reversed(order):  # whom it lets wait for more comes later in this loop
        read = sorted(before[name], key=order.index)
        before[name] = set(read[-_LANES:])
        for early, late in zip(read, read[_LANES:], strict=False):
            before[late].add(early)
    jobs["spec"]["replicatedJobs"] = [_job(plan, one, options, before[one.name]) for one in plan.groups]
    return dump_yaml(recipe) + "---\n" + dump_yaml(jobs)


def _job(plan: LaunchPlan, group: Group, options: ClusterOptions, before: set[str]) -> dict[str, Any]:
    if group.parts > 1:  # each is tried again alone
        spec = {**yaml.safe_load(_IN_PARTS), "backoffLimitPerIndex": options.restarts}
    else:
        spec = yaml.safe_load(_TOGETHER)
    spec["completions"] = spec["parallelism"] = group.parts * group.machines.nodes
    spec["template"] = {"spec": _pod(plan, group, options)}
    job: dict[str, Any] = {"name": group.name, "template": {"spec": spec}}
    if before:
        job["dependsOn"] = [{"name": name, "status": "Complete"} for name in sorted(before)]
    return job


def _pod(plan: LaunchPlan, group: Group, options: ClusterOptions) -> dict[str, Any]:
    machines = group.machines
    mounts = yaml.safe_load(_MOUNTS)
    pod: dict[str, Any] = yaml.safe_load(_POD)
    image, claim = options.require_given("image", "volume")
    pod["volumes"][0]["persistentVolumeClaim"] = {"claimName": claim}
    pod["volumes"][1]["configMap"] = {"name": plan.name}
    mounts[0]["mountPath"] = options.mount
    command = plan.command(group, "/etc/motionloom/recipe.yaml", ["motionloom"])
    if group.parts > 1:
        part = f"hardware.part=$((JOB_COMPLETION_INDEX + 1))/{group.parts}"
        command = ["sh", "-c", f"exec {shlex.join(command)} --set {part}"]
    env = {"HOME": options.mount}
    if machines.nodes > 1:  # the Job says which node each is (JOB_COMPLETION_INDEX)
        env["MASTER_ADDR"] = f"{plan.job(group)}-0-0.{plan.name}"
    limits = {"memory": f"{round(options.memory_gb * machines.processes * 1024)}Mi"}
    requests = {"cpu": str(options.cpus * machines.processes), **limits}
    if machines.gpus:
        limits[options.gpu_resource] = str(machines.gpus)
    pod["containers"] = [
        {
            "name": "motionloom",
            "image": image,
            "workingDir": options.mount,
            "command": command,
            "env": [{"name": name, "value": value} for name, value in env.items()],
            "resources": {"requests": requests, "limits": limits},
            "volumeMounts": mounts,
        }
    ]
    return pod
