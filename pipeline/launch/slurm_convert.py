"""A conversion on a SLURM cluster: arrays of parts, then one job that writes the manifest.

- Three links at most: features (only for sources that need that step), shards, manifest; each starts when all
  tasks of the one before have succeeded and is cancelled when one has not. A task makes every n-th shard, so
  that starting Python is paid once for many.
- Every task is idempotent: after a failure the same command makes only what is missing.
- Submitting is submitit's work. It stores the function to run as a pickle, so that function is its own
  `CommandFunction` around a list of words, `python -m motionloom.pipeline.launch.convert_job JOB.json ...`:
  none of our objects are pickled, what the node runs can be read in the log, and the results, which submitit
  pickles too, are never opened here: each job leaves a JSON file instead.
- Which jobs are still there is asked with `squeue`; accounting (`sacct`) is not needed.
"""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator
from rich.console import Console
from rich.progress import Progress

from motionloom.datasets.base.files import write_json
from motionloom.datasets.convert.common.conversion import Conversion
from motionloom.datasets.convert.table import converter_named
from motionloom.datasets.schema import Config, Manifest, UserError
from motionloom.datasets.shards.index import MANIFEST_FILE
from motionloom.pipeline.launch.convert_job import ConvertJob, JobResult, Step, result_path
from motionloom.pipeline.launch.options import fields_of, one_line_options

LOG_FOLDER = ".slurm"
"""Inside the folder of the shards: records, logs and results of the jobs. May be deleted when all is over."""

_RECORD = "job.json"
_SILENT_POLLS = 30
"""How often in a row `squeue` may fail before waiting is given up."""


class ClusterConfig(Config):
    """What to ask SLURM for."""

    partition: str | None = None
    """Partition; default the cluster's."""
    tasks: int = Field(default=8, ge=1)
    """Tasks of an array, each with its share of the shards; a few per node are enough."""
    cpus_per_task: int = Field(default=2, ge=1)
    """Processes of a task."""
    time_minutes: int = Field(default=120, ge=1)
    """Time limit of a task."""
    memory_gb: float = Field(default=4.0, gt=0)
    """Memory of a task; a process needs about half a GB (BVH; longer clips need more)."""
    account: str | None = None
    """Account to charge."""
    qos: str | None = None
    """Quality of service."""
    extra: dict[str, str] = Field(default_factory=dict)
    """More options of sbatch, such as `{"constraint": "cpu"}`."""

    _extra_is_plain = field_validator("extra")(one_line_options)

    @classmethod
    def from_words(cls, words: Sequence[str], where: str = "--cluster") -> ClusterConfig:
        """From `KEY=VALUE` words; keys that are not ours are sbatch's when written `extra.KEY=VALUE`."""
        return cls.parse(fields_of(words, where), where)


@dataclass(frozen=True)
class Link:
    """One submitted step: an array of `count` tasks, or a single job."""

    step: Step
    job: str
    """Job id."""
    count: int


@dataclass(frozen=True)
class Submission:
    """The jobs of a conversion."""

    out: Path
    logs: Path
    links: tuple[Link, ...]

    @property
    def ids(self) -> list[str]:
        """Job ids, in order."""
        return [link.job for link in self.links]

    def log_of(self, link: Link, index: int) -> Path:
        """Standard error of a task."""
        task = f"{link.job}_{index}" if link.count > 1 else link.job
        return self.logs / f"{task}_0_log.err"


def submit_conversion(
    kind: str,
    fields: dict[str, Any],
    out: Path,
    *,
    cluster: ClusterConfig,
    console: Console,
    strict: bool = False,
    seed: int = 0,
    clips_per_shard: int = 256,
) -> Submission:
    """Plan here, submit the jobs, say their ids; `wait_for` waits for them.

    `out`, the source and this Python must lie where every node sees them under the same path.
    """
    if shutil.which("sbatch") is None:
        raise UserError("no sbatch here: start this where jobs are submitted, or convert without --cluster")
    converter = converter_named(kind)
    config = converter.config().parse(fields, f"data convert {kind}")
    out = out.absolute()
    conversion = converter.prepare(
        config, out=out, workers=cluster.cpus_per_task, progress=console.is_terminal
    )
    if strict:
        conversion.plan.require_whole()
    conversion.plan.require_settled()
    seen = conversion.look()  # here and not in the jobs: all parts would look at the same clips
    if seen is not None:
        seen.require_people(conversion.plan.name)
    steps = _steps(conversion, cluster.tasks, clips_per_shard)
    record = ConvertJob(
        kind=kind,
        fields={name: _absolute(value) for name, value in config},
        out=out,
        workers=cluster.cpus_per_task,
        seed=seed,
        clips_per_shard=clips_per_shard,
        strict=strict,
    )
    logs = new_folder(out / LOG_FOLDER)
    write_json(logs / _RECORD, record.dump())
    links: list[Link] = []
    for step, count in steps:
        try:
            links.append(Link(step, _submit(step, count, logs, cluster, after=links[-1:]), count))
        except UserError:
            cancel_jobs([link.job for link in links])
            raise
        after = f", after job {links[-2].job}" if len(links) > 1 else ""
        console.print(f"{step}: job {links[-1].job}, {count} task{'s' * (count > 1)}{after}")
    submission = Submission(out, logs, tuple(links))
    console.print(
        f"watch: squeue --jobs {','.join(submission.ids)}; stop: scancel {' '.join(submission.ids)}; "
        f"logs: {logs}",
        soft_wrap=True,
    )
    return submission


def wait_for(submission: Submission, console: Console, *, poll_seconds: float = 5.0) -> Manifest:
    """Wait until no job is left; the manifest, or a `UserError` that says which task failed and why."""
    silent = 0
    with Progress(console=console, disable=not console.is_terminal) as bar:
        bars = {link.step: bar.add_task(link.step, total=link.count) for link in submission.links}
        while True:
            alive = _alive(submission.ids)
            silent = silent + 1 if alive is None else 0
            if silent > _SILENT_POLLS:
                raise UserError(
                    f"squeue does not answer; the jobs go on: squeue --jobs {','.join(submission.ids)}"
                )
            for link in submission.links:
                bar.update(bars[link.step], completed=sum(map(bool, _results(submission, link))))
            if alive is not None and not alive:
                break
            time.sleep(poll_seconds)
    _require_success(submission)
    return Manifest.load_json(submission.out / MANIFEST_FILE)


def _steps(conversion: Conversion[Any], tasks: int, clips_per_shard: int) -> list[tuple[Step, int]]:
    """The links and how many tasks each has: no more than it has work for."""
    counts = Counter(split for split, _ in conversion.plan.items)
    shards = sum(-(-count // clips_per_shard) for count in counts.values())
    if not shards:
        raise UserError(f"{conversion.plan.name}: no clip to convert; see the reasons with --plan")
    steps: list[tuple[Step, int]] = [("shards", min(tasks, shards)), ("manifest", 1)]
    if conversion.features is not None:
        steps.insert(0, ("features", min(tasks, len(conversion.features.batches))))
    return steps


def _submit(step: Step, count: int, logs: Path, cluster: ClusterConfig, after: Sequence[Link]) -> str:
    """Submit one link; its job id."""
    import submitit

    executor = submitit.SlurmExecutor(folder=logs, python=f"{shlex.quote(sys.executable)} -P")
    executor.update_parameters(
        job_name=f"motionloom-{step}",
        partition=cluster.partition,
        time=cluster.time_minutes,
        nodes=1,
        ntasks_per_node=1,
        cpus_per_task=cluster.cpus_per_task,
        mem=f"{round(cluster.memory_gb * 1024)}MB",
        account=cluster.account,
        qos=cluster.qos,
        array_parallelism=count,
        dependency=f"afterok:{after[0].job}" if after else None,
        additional_parameters={"kill-on-invalid-dep": "yes", **cluster.extra},
        # From 22.05 on a step no longer takes its CPUs from the job's request.
        srun_args=["--cpus-per-task", str(cluster.cpus_per_task)],
    )
    words = [sys.executable, "-P", "-m", "motionloom.pipeline.launch.convert_job", str(logs / _RECORD), step]
    commands = [submitit.helpers.CommandFunction([*words, str(index), str(count)]) for index in range(count)]
    try:
        jobs = executor.submit_array(commands)
    except submitit.core.utils.FailedJobError as error:
        raise UserError(f"sbatch refused the {step} job: {str(error).strip()}") from None
    return str(jobs[0].job_id).partition("_")[0]


def _alive(ids: Sequence[str]) -> list[str] | None:
    """Those of our jobs that wait or run; None when SLURM does not answer."""
    asked = subprocess.run(
        ["squeue", "--noheader", "--format=%A", f"--jobs={','.join(ids)}"], capture_output=True, text=True
    )
    if asked.returncode == 0:
        return asked.stdout.split()
    return [] if "Invalid job id" in asked.stderr else None  # all of them are forgotten: long over


def cancel_jobs(ids: Sequence[str]) -> None:
    """Cancel jobs; those that are over already do not matter."""
    if ids:
        subprocess.run(["scancel", *ids], capture_output=True)


def _results(submission: Submission, link: Link) -> list[JobResult | None]:
    """Per task what it left, None where it has left nothing."""
    out: list[JobResult | None] = []
    for index in range(link.count):
        path = result_path(submission.logs, link.step, index)
        out.append(JobResult.load_json(path) if path.exists() else None)
    return out


def _require_success(submission: Submission) -> None:
    """`UserError` that names the first task that failed, its reason and its log."""
    for link in submission.links:
        results = _results(submission, link)
        failed = [index for index, result in enumerate(results) if result is None or not result.ok]
        if not failed:
            continue
        first = results[failed[0]]
        reason = first.message if first else "killed, out of memory or out of time (it left no result)"
        more = f" and {len(failed) - 1} more" if len(failed) > 1 else ""
        later = submission.links[submission.links.index(link) + 1 :]
        cancelled = f"; cancelled: {', '.join(f'{x.step} job {x.job}' for x in later)}" if later else ""
        raise UserError(
            f"{link.step} job {link.job}: task {failed[0]}{more} of {link.count} failed: {reason}; "
            f"log: {submission.log_of(link, failed[0])}{cancelled}. The same command makes what is missing."
        )


def new_folder(parent: Path) -> Path:
    """A folder of its own for every submission."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    for number in range(1000):
        folder = parent / (f"{stamp}-{number}" if number else stamp)
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            continue
    raise UserError(f"{parent}: too many submissions in one second")


def _absolute(value: Any) -> Any:
    """Config values as plain data; paths no longer depend on the working directory."""
    if isinstance(value, Path):
        return str(value.expanduser().absolute())
    if isinstance(value, Config):
        return {name: _absolute(inner) for name, inner in value}
    if isinstance(value, (list, tuple)):
        return [_absolute(inner) for inner in value]
    return value
