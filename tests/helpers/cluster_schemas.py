# ruff: noqa: N815 - the fields are called as the APIs call them
"""What Kubernetes, Kubeflow Trainer and SkyPilot accept: the published fields of the objects that we write.

Written from the documentation of `batch/v1` Job and `v1` ConfigMap (Kubernetes 1.31), of `TrainJob` in
`trainer.kubeflow.org/v1alpha1` (Kubeflow Trainer 2.2) and of SkyPilot's task YAML (0.14). Any other field is
refused, as is one that Trainer 2.2 removed (`podTemplateOverrides`, `elasticPolicy`, a replica's spec of v1).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, model_validator

Name = Annotated[str, Field(pattern=r"^[a-z0-9]([a-z0-9.-]{0,251}[a-z0-9])?$")]
Label = Annotated[str, Field(pattern=r"^[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?$")]
TrainName = Annotated[str, Field(pattern=r"^[a-z]([-a-z0-9]{0,61}[a-z0-9])?$")]
LabelKey = Annotated[str, Field(pattern=r"^([a-z0-9.-]{1,253}/)?[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$")]
LabelValue = Annotated[str, Field(pattern=r"^([A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?)?$")]
Quantity = Annotated[str, Field(pattern=r"^[0-9]+(Mi|Gi)?$")]


class Strict(BaseModel):
    """No other fields, no conversions: a YAML number is no text."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Metadata(Strict):
    name: Name
    namespace: Label | None = None
    labels: dict[LabelKey, LabelValue] = {}


class EnvVar(Strict):
    name: Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
    value: str


class Resources(Strict):
    requests: dict[str, Quantity] = {}
    limits: dict[str, Quantity] = {}

    @model_validator(mode="after")
    def _gpus_are_not_shared(self) -> Self:
        """An extended resource is asked for in equal numbers."""
        for name in self.requests.keys() | self.limits.keys():
            if "/" in name and self.requests.get(name) != self.limits.get(name):
                raise ValueError(f"{name}: request and limit differ")
        return self


class Mount(Strict):
    name: Label
    mountPath: Annotated[str, Field(pattern=r"^/[^:]*$")]
    readOnly: bool = False


class Claim(Strict):
    claimName: Name


class EmptyDir(Strict):
    medium: Literal["", "Memory"]


class ConfigMapVolume(Strict):
    name: Name


class Volume(Strict):
    name: Label
    persistentVolumeClaim: Claim | None = None
    emptyDir: EmptyDir | None = None
    configMap: ConfigMapVolume | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        sources = (self.persistentVolumeClaim, self.emptyDir, self.configMap)
        if sum(source is not None for source in sources) != 1:
            raise ValueError("a volume has one source")
        return self


class PodSecurity(Strict):
    runAsNonRoot: bool
    runAsUser: int
    runAsGroup: int
    fsGroup: int


class Container(Strict):
    name: Label
    image: str
    command: list[str]
    env: list[EnvVar] = []
    resources: Resources
    volumeMounts: list[Mount] = []


class PodSpec(Strict):
    restartPolicy: Literal["Never", "OnFailure"]
    securityContext: PodSecurity
    containers: Annotated[list[Container], Field(min_length=1)]
    volumes: list[Volume] = []

    @model_validator(mode="after")
    def _mounts_are_volumes(self) -> Self:
        names = {volume.name for volume in self.volumes}
        if any(mount.name not in names for one in self.containers for mount in one.volumeMounts):
            raise ValueError("a mount of no volume")
        return self


class PodMetadata(Strict):
    labels: dict[LabelKey, LabelValue]


class PodTemplate(Strict):
    metadata: PodMetadata
    spec: PodSpec


class PodCondition(Strict):
    type: Literal["DisruptionTarget"]
    status: Literal["True", "False", "Unknown"]


class FailureRule(Strict):
    action: Literal["FailJob", "FailIndex", "Ignore", "Count"]
    onPodConditions: list[PodCondition]


class FailurePolicy(Strict):
    rules: Annotated[list[FailureRule], Field(max_length=20)]


class JobSpec(Strict):
    suspend: bool
    backoffLimit: Annotated[int, Field(ge=0)]
    activeDeadlineSeconds: Annotated[int, Field(ge=1)]
    podFailurePolicy: FailurePolicy
    completionMode: Literal["NonIndexed", "Indexed"] = "NonIndexed"
    completions: Annotated[int, Field(ge=1)] | None = None
    parallelism: Annotated[int, Field(ge=0)] | None = None
    template: PodTemplate

    @model_validator(mode="after")
    def _rules_of_the_api(self) -> Self:
        if self.template.spec.restartPolicy != "Never":
            raise ValueError("podFailurePolicy needs restartPolicy Never")
        if self.completionMode == "Indexed" and self.completions is None:
            raise ValueError("an Indexed Job says how many completions")
        return self


class Job(Strict):
    apiVersion: Literal["batch/v1"]
    kind: Literal["Job"]
    metadata: Metadata
    spec: JobSpec


class ConfigMap(Strict):
    apiVersion: Literal["v1"]
    kind: Literal["ConfigMap"]
    metadata: Metadata
    data: dict[Annotated[str, Field(pattern=r"^[-._a-zA-Z0-9]+$")], str]


class RuntimeRef(Strict):
    name: Name
    apiGroup: str = "trainer.kubeflow.org"
    kind: Literal["ClusterTrainingRuntime", "TrainingRuntime"] = "ClusterTrainingRuntime"


class Trainer(Strict):
    image: Annotated[str, Field(max_length=500)]
    numNodes: Annotated[int, Field(ge=1)]
    numProcPerNode: Annotated[int, Field(ge=1)]
    command: Annotated[list[str], Field(max_length=128)]
    env: list[EnvVar] = []
    resourcesPerNode: Resources


class ContainerPatch(Strict):
    """No `env`: the container `node` takes it from the trainer."""

    name: Literal["node"]
    volumeMounts: list[Mount]


class PodPatchSpec(Strict):
    securityContext: PodSecurity
    volumes: list[Volume]
    containers: list[ContainerPatch]


class PodPatch(Strict):
    spec: PodPatchSpec


class JobPatchSpec(Strict):
    template: PodPatch


class JobPatch(Strict):
    spec: JobPatchSpec


class ReplicatedJobPatch(Strict):
    name: Literal["node"]
    template: JobPatch


class JobSetPatchSpec(Strict):
    replicatedJobs: list[ReplicatedJobPatch]


class JobSetPatch(Strict):
    spec: JobSetPatchSpec


class RuntimeSpecPatch(Strict):
    template: JobSetPatch


class RuntimePatch(Strict):
    manager: Annotated[str, Field(min_length=1, max_length=253)]
    trainingRuntimeSpec: RuntimeSpecPatch


class TrainJobSpec(Strict):
    suspend: bool
    activeDeadlineSeconds: Annotated[int, Field(ge=1)]
    runtimeRef: RuntimeRef
    trainer: Trainer
    runtimePatches: Annotated[list[RuntimePatch], Field(max_length=16)]


class TrainMetadata(Metadata):
    name: TrainName


class TrainJob(Strict):
    apiVersion: Literal["trainer.kubeflow.org/v1alpha1"]
    kind: Literal["TrainJob"]
    metadata: TrainMetadata
    spec: TrainJobSpec


class SkyStorage(Strict):
    source: Annotated[str, Field(pattern=r"^(s3|gs|r2|https|cos|oci|nebius|cw)://")]
    mode: Literal["MOUNT", "COPY", "MOUNT_CACHED"]


class SkyResources(Strict):
    infra: str | None = None
    cpus: str
    memory: str
    accelerators: Annotated[dict[str, int], Field(max_length=1)] | None = None
    image_id: str | None = None
    use_spot: bool = False


class SkyTask(Strict):
    name: str
    workdir: str | None = None
    num_nodes: int | None = None
    resources: SkyResources | None = None
    volumes: dict[str, str] = {}
    file_mounts: dict[str, str | SkyStorage] = {}
    setup: str | None = None
    run: str | None = None


_KUBERNETES: TypeAdapter[Job | TrainJob | ConfigMap] = TypeAdapter(
    Annotated[Job | TrainJob | ConfigMap, Field(discriminator="kind")]
)


def kubernetes_object(data: Any) -> Job | TrainJob | ConfigMap:
    """The object as its API has it; raises where a field or a value is none of the API's."""
    return _KUBERNETES.validate_python(data)
