"""What the jobs of a launch ask their cluster for: SLURM, Kubernetes (JobSet) or SkyPilot."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Annotated, Self

from pydantic import AfterValidator, Field, field_validator

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError


def _one_line(text: str) -> str:
    if not text or not text.isprintable():
        raise ValueError("write one line of printable characters")
    return text


Line = Annotated[str, AfterValidator(_one_line)]
"""Text of one line: a batch script must not get another."""

WARN_SECONDS = 120
"""Seconds before its time limit at which a job is queued again, and grace of an eviction [ours]: a training
saves a step in a few."""


class ClusterOptions(Config):
    """`hardware.cluster` of a recipe; `motionloom launch --cluster KEY=VALUE` goes before it."""

    cpus: int = Field(8, ge=1)
    """CPU cores for each process; a conversion uses all of its one."""
    memory_gb: float = Field(64, gt=0)
    """Memory for each process."""
    parts: int = Field(1, ge=1)
    """Jobs that make a part of every conversion each."""
    clips_per_gpu: int = Field(32, ge=1)
    """Clips of a batch that a GPU takes at least: a training gets as many as its batch has for. By the step
    on an H100 (docs/results.md, "One GPU"): with 30 clips those of TMA and GPT end as soon as their 2,000
    kernels are launched at 10 us each, so that more GPUs are no faster."""

    partition: Line | None = None
    """SLURM: partition of the groups with GPUs, and of the others if `light_partition` is not given; default
    the cluster's."""
    light_partition: Line | None = None
    """SLURM: partition of the groups without GPUs."""
    time_minutes: int = Field(1440, ge=2 * WARN_SECONDS // 60)
    """SLURM: time limit of each group."""
    requeues: int = Field(100, ge=0)
    """SLURM: times that one job may be queued again at its time limit; 0 lets it end there."""
    extra: dict[str, Line] = Field(default_factory=dict)
    """SLURM: more options of sbatch: `extra.account=me`, `extra.constraint=h100`."""

    image: Line | None = None
    """Kubernetes, SkyPilot: container image in which `motionloom` is installed."""
    volume: Line | None = None
    """Kubernetes: claim (ReadWriteMany, with file locks) that holds data and runs; SkyPilot: volume."""
    mount: Line = Field("/motionloom", pattern="^/")
    """Kubernetes, SkyPilot: where that is mounted, and the folder in which the commands run."""
    restarts: int = Field(3, ge=0)
    """Kubernetes, SkyPilot: times that a job starts again after an error; after a signal it always does."""

    queue: Line | None = None
    """Kubernetes: local queue of Kueue."""
    gpu_resource: Line = "nvidia.com/gpu"
    """Kubernetes: name of the GPUs."""

    gpu: Line = "H100"
    """SkyPilot: kind of the GPUs."""
    infra: Line | None = None
    """SkyPilot: cloud, region or context, such as `aws/us-east-1`; default the cheapest."""
    spot: bool = True
    """SkyPilot: spot machines, which are cheaper and may be taken away."""
    bucket: Line | None = None
    """SkyPilot: bucket in place of the volume, such as `s3://mine`; for groups of one machine."""

    @field_validator("extra")
    @classmethod
    def _are_options(cls, extra: dict[str, str]) -> dict[str, str]:
        for name in extra:
            if not re.fullmatch(r"[a-z][a-z0-9-]*", name):
                raise ValueError(f"'{name}': an sbatch option is a word such as 'mail-type'")
        return extra

    def require_given(self, *keys: str) -> list[str]:
        """Return these options; `UserError` for one that is not set and has no default."""
        for key in keys:
            if not getattr(self, key):
                raise UserError(f"this needs --cluster {key}=NAME, or hardware.cluster.{key} in the recipe")
        return [str(getattr(self, key)) for key in keys]

    def with_words(self, words: Sequence[str]) -> Self:
        """Return the options with `KEY=VALUE` words before them; `extra.KEY=VALUE` is an option of sbatch."""
        fields: dict[str, object] = {}
        extra = dict(self.extra)
        for word in words:
            key, equals, value = word.partition("=")
            if not equals:
                raise UserError(f"--cluster '{word}': write KEY=VALUE, for example partition=gpu")
            if key.startswith("extra."):
                extra[key.removeprefix("extra.")] = value
            else:
                fields[key] = value
        return self.parse({**self.dump(), **fields, "extra": extra}, "--cluster")
