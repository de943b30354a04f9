"""What to ask a cluster for: the options of `motionloom launch --cluster KEY=VALUE`, one class an engine."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from motionloom.datasets.schema import Config, UserError


def fields_of(words: Sequence[str], where: str) -> dict[str, Any]:
    """Fields from `KEY=VALUE` words; `extra.KEY=VALUE` goes into the field `extra`."""
    fields: dict[str, Any] = {}
    for word in words:
        key, separator, value = word.partition("=")
        if not separator:
            raise UserError(f"{where} '{word}': write KEY=VALUE, for example partition=cpu")
        if key.startswith("extra."):
            fields.setdefault("extra", {})[key.removeprefix("extra.")] = value
        else:
            fields[key] = value
    return fields


def one_line_options(extra: dict[str, str]) -> dict[str, str]:
    """Refuse what is no option of sbatch, or would begin a line of its own in a batch script."""
    for name, value in extra.items():
        if not re.fullmatch(r"[a-z][a-z0-9-]*", name) or not _one_line(value):
            raise ValueError(f"'{name}': an sbatch option is a word such as 'mail-type' and has one line")
    return extra


def _one_line(text: str) -> bool:
    return text.isprintable()


def _line(text: str) -> str:
    if not text or not _one_line(text):
        raise ValueError("write one line of printable characters")
    return text


def _mount(path: PurePosixPath) -> PurePosixPath:
    if not path.is_absolute() or path == PurePosixPath("/") or ".." in path.parts or ":" in str(path):
        raise ValueError("write an absolute path other than / without .. and colons")
    return path


Line = Annotated[str, AfterValidator(_line)]
"""Text of one line."""

Mount = Annotated[PurePosixPath, AfterValidator(_mount)]
"""Where a volume is mounted."""


class LaunchOptions(Config):
    """What all engines take."""

    name: str | None = Field(None, pattern=r"^[a-z]([a-z0-9-]{0,28}[a-z0-9])?$")
    """Of the jobs; default made from the recipe's."""
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

    @classmethod
    def from_words(cls, words: Sequence[str], where: str = "--cluster") -> Self:
        """From `KEY=VALUE` words."""
        return cls.parse(fields_of(words, where), where)


class SlurmOptions(LaunchOptions):
    """Of `--engine slurm`."""

    partition: Line | None = None
    """Partition of the groups with GPUs, and of the others if `light_partition` is not given; default the
    cluster's."""
    light_partition: Line | None = None
    """Partition of the groups without GPUs."""
    account: Line | None = None
    """Account to charge."""
    qos: Line | None = None
    """Quality of service."""
    parts: int = Field(8, ge=1)
    """Tasks of the array that a conversion at the beginning is cut into; 1 for a plain job."""
    warn_seconds: int = Field(120, ge=60)
    """How long before its time limit a job is queued again."""
    requeues: int = Field(100, ge=0)
    """How often one job may be queued again at its time limit; 0 lets it end there."""
    extra: dict[str, str] = Field(default_factory=dict)
    """More options of sbatch, such as `{"constraint": "h100"}`."""

    _extra_is_plain = field_validator("extra")(one_line_options)

    @model_validator(mode="after")
    def _warned_in_time(self) -> Self:
        if 2 * self.warn_seconds > 60 * min(self.time_minutes, self.light_minutes):
            raise ValueError(
                f"warn_seconds {self.warn_seconds} is more than half of a time limit: jobs would be "
                f"queued again before they have done anything; raise time_minutes and light_minutes"
            )
        return self


class KubernetesOptions(LaunchOptions):
    """Of `--engine kubernetes`."""

    image: Line
    """Container image with motionloom installed."""
    claim: Annotated[str, Field(pattern=r"^[a-z0-9]([a-z0-9.-]{0,251}[a-z0-9])?$")]
    """PersistentVolumeClaim (ReadWriteMany) with the data; the run folder is made there."""
    mount: Mount = PurePosixPath("/motionloom")
    """Where the claim is mounted; relative paths of the recipe start here."""
    namespace: str | None = Field(None, pattern=r"^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$")
    """Namespace; default that of kubectl's context."""
    runtime: str = Field("torch-distributed", pattern=r"^[a-z0-9]([a-z0-9.-]{0,251}[a-z0-9])?$")
    """ClusterTrainingRuntime of Kubeflow Trainer, for trainings on several nodes."""
    gpu_resource: str = Field("nvidia.com/gpu", pattern=r"^[a-z0-9.-]+/[A-Za-z0-9._-]+$")
    """What a GPU is called among the resources of a node."""
    user: int = Field(1000, ge=1)
    """User and group id of all containers; the runtime above has 1000, and all write one run folder."""
    retries: int = Field(10, ge=0)
    """How often a failed pod of a Job is started again; evictions are not counted."""
    parts: int = Field(8, ge=1)
    """Pods of the Indexed Job that a conversion at the beginning is cut into; 1 for a plain Job."""


class SkyPilotOptions(LaunchOptions):
    """Of `--engine skypilot`."""

    storage: Line
    """Where the run folder lives: a SkyPilot volume by name, or a bucket (s3://NAME, gs://NAME, ...)."""
    mount: Mount = PurePosixPath("/motionloom")
    """Where the storage is mounted; relative paths of the recipe start here."""
    accelerator: str | None = Field(None, pattern=r"^[A-Za-z0-9._-]+$")
    """Kind of GPU as SkyPilot calls it, such as H100."""
    infra: Line | None = None
    """Where to run, such as aws/us-east-1 or k8s; default the cheapest."""
    image: Line | None = None
    """Container image with motionloom installed."""
    workdir: Path | None = None
    """Folder that is copied to the machines, such as a checkout of motionloom; `setup` runs in it."""
    setup: str | None = None
    """Shell commands that install motionloom; default `pip install .` where there is a workdir."""
    use_spot: bool = False
    """Take machines that may be withdrawn; the run goes on from its newest checkpoint."""
