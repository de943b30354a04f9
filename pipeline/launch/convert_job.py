"""One job of a conversion: the whole of it, or a part, from a plain JSON record.

    python -m motionloom.pipeline.launch.convert_job JOB.json STEP INDEX COUNT

is what runs on a node of a cluster (`slurm_convert.py` submits it). STEP is `features`, `shards` or
`manifest`. What became of it is written beside the record as `STEP-INDEX.json`, so that whoever waits needs
nothing but files.
"""

from __future__ import annotations

import platform
import signal
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, cast

from pydantic import Field

from motionloom.datasets.base.files import write_json
from motionloom.datasets.base.os_errors import sentence_of
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.table import converter_named
from motionloom.datasets.schema import Config, Manifest, UserError
from motionloom.datasets.shards.options import Part

Step = Literal["features", "shards", "manifest"]


class ConvertJob(Config):
    """A conversion as a record."""

    kind: str
    """Name in the table of converters."""
    fields: dict[str, Any]
    """The converter's config."""
    out: Path
    workers: int = Field(default=1, ge=1)
    seed: int = 0
    clips_per_shard: int = Field(default=256, ge=1)
    strict: bool = False


class JobResult(Config):
    """What became of one job."""

    ok: bool
    message: str
    """What was made, or what went wrong."""
    seconds: float
    host: str


def result_path(folder: Path, step: Step, index: int) -> Path:
    """Where a job says what became of it."""
    return folder / f"{step}-{index:06d}.json"


def run_part(job: ConvertJob, part: Part | None = None, *, progress: bool = False) -> Manifest:
    """Make one part; without `part` everything that is missing, and the manifest."""
    converter = converter_named(job.kind)
    config = converter.config().parse(job.fields, f"data convert {job.kind}")
    return run_conversion(
        converter.prepare(config, out=job.out, workers=job.workers, progress=progress),
        job.out,
        workers=job.workers,
        strict=job.strict,
        seed=job.seed,
        clips_per_shard=job.clips_per_shard,
        progress=progress,
        part=part,
    )


def main(arguments: Sequence[str]) -> int:
    """Run one job; the exit code is 0 only when it is done."""
    record, step, index, count = Path(arguments[0]), cast(Step, arguments[1]), *map(int, arguments[2:4])
    start, ok = time.monotonic(), False
    try:
        part = None if step == "manifest" else Part(index, count, step)
        made = run_part(ConvertJob.load_json(record), part)
        clips = sum(shard.samples for shard in made.shards)
        message = f"{len(made.shards)} shards, {clips} clips"
        ok = True
    except UserError as error:
        message = str(error)
    except Exception as error:  # the one who waits sees the result, not this process's output
        message = sentence_of(error) or f"{type(error).__name__}: {error}"
        traceback.print_exc()
    print(f"{step} {index + 1} of {count}: {message}", flush=True)
    result = JobResult(ok=ok, message=message, seconds=time.monotonic() - start, host=platform.node())
    write_json(result_path(record.parent, step, index), result.dump())
    return 0 if ok else 1


if __name__ == "__main__":
    # The warning before a time limit or a preemption is for the process around this one. A part that is cut
    # off has lost only its unfinished shard.
    signal.signal(signal.SIGUSR2, signal.SIG_IGN)
    raise SystemExit(main(sys.argv[1:]))
