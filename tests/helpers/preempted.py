"""A recipe on the SLURM of two nodes: launched by one command, and preempted while it trains."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

from bvh_clips import write_clip, write_map
from kill_matrix import Seen, compare, finished_files
from slurm_cluster import Cluster
from step_records import PAUSE, RECORDS, rows_of

RECIPE = """
name: preempted
seed: 5
hardware: {{accelerator: cpu, threads: 1, loggers: []}}
stages:
  data:
    {{kind: bvh, source: {source}, joint_map: {source}/joint_map.json, captions: {source}/captions.jsonl,
      licence: CC0, fps: 20}}
  stats: {{kind: stats}}
  tokenizer:
    kind: rvq
    net: {{part: body, width: 32, depth: 1, code_dim: 16, num_codes: 32, levels: 2}}
    train: {{steps: {steps}, batch_size: 8, checkpoint_every: 25, validate_every: 50}}
  evaluate: {{kind: evaluate}}
"""
"""Conversion, training and evaluation; no stage wants a text encoder."""

SPLITS = ("train", "train", "train", "train", "val", "test")
TRAINED = ("tokenizer", "evaluate")
"""What is made anew under preemption."""

GROUPS = ("1-parts", "2-data", "3-tokenizer")
"""What a launch makes of it."""

ASKED = (
    "partition=main", "cpus=1", "memory_gb=1",
    "clips_per_gpu=4", "parts=2",
)  # fmt: skip


def write_recipe(folder: Path, steps: int) -> Path:
    """The recipe, and twelve BVH files for it."""
    source = folder / "mocap"
    rows = []
    for number in range(12):
        write_clip(source / f"clip{number:02d}.bvh", number)
        split = SPLITS[number % len(SPLITS)]
        rows.append(json.dumps({"id": f"clip{number:02d}", "captions": ["a figure sways"], "split": split}))
    write_map(source / "joint_map.json")
    (source / "captions.jsonl").write_text("\n".join(rows))
    recipe = folder / "preempted.yaml"
    recipe.write_text(RECIPE.format(steps=steps, source=source.absolute()))
    return recipe


@dataclass
class Launched:
    """The jobs of a launch, and what their trainings leave."""

    cluster: Cluster
    ids: list[str]
    records: Path
    run: Path

    @property
    def training(self) -> str:
        """The job that trains."""
        return self.ids[-1]

    def rows(self) -> list[tuple[int, dict[str, Any]]]:
        """(rank, line) of every step so far, of all starts."""
        return list(rows_of(self.records))

    def files(self) -> dict[str, str]:
        """sha256 of what the stages behind the data keep."""
        return {
            f"{name}/{file}": digest
            for name in TRAINED
            for file, digest in finished_files(self.run / "stages" / name).items()
        }

    def states(self) -> list[str]:
        """Of the jobs; those of an array are one word where they agree."""
        shown = self.cluster.ask(
            "squeue", "--noheader", "--states=all", "--format=%F %T", f"--jobs={','.join(self.ids)}"
        )
        found: dict[str, set[str]] = {}
        for line in shown.splitlines():
            job, state = line.split()
            found.setdefault(job, set()).add(state)
        return ["+".join(sorted(found.get(job, {""}))) for job in self.ids]

    def logs(self) -> str:
        """Output of all jobs."""
        return "\n".join(path.read_text() for path in sorted(self.run.glob(".slurm/*/*.log")))

    def wait_for_step(self, step: int, start: int, seconds: float = 180) -> None:
        """Until rank 0 has trained `step` in the start of that number."""
        self._until(
            lambda: any(
                rank == 0 and row["step"] >= step and row["start"] == start for rank, row in self.rows()
            ),
            f"step {step} of start {start}",
            seconds,
        )

    def wait_for_end(self, seconds: float = 240) -> None:
        """Until no job waits or runs."""
        live = {"PENDING", "RUNNING", "COMPLETING", "CONFIGURING", "REQUEUED", ""}
        self._until(lambda: not any(live & set(s.split("+")) for s in self.states()), "the end", seconds)

    def _until(self, ready: Any, what: str, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while not ready():
            if time.monotonic() > deadline:
                raise AssertionError(f"{what} did not come: {self.states()}\n{self.logs()}")
            time.sleep(0.1)


def launch(cluster: Cluster, recipe: Path, run: Path, *, pause: float = 0.0) -> Launched:
    """`motionloom launch` on both nodes; every step leaves a line beside the run folder."""
    records = run.with_name(f"{run.name}-records")
    records.mkdir(parents=True)
    words = ["motionloom", "launch", str(recipe), "--nodes", "2", "--gpus-per-node", "0", "--out", str(run)]
    words += [word for asked in ASKED for word in ("--cluster", asked)]
    path = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(Path(__file__).parent)]))
    watched = {"MOTIONLOOM_STAGES": "watched_steps", RECORDS: str(records), PAUSE: str(pause)}
    before = _jobs(cluster)
    # The nodes' names are SLURM's own here and no host's.
    meet = {"MASTER_ADDR": "127.0.0.1", "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    with mock.patch.dict(os.environ, watched | meet), mock.patch.object(sys, "argv", words):
        from motionloom.pipeline.cli.main import main as program

        try:
            program()
        except SystemExit as end:
            if end.code:
                raise AssertionError(f"motionloom launch ended with {end.code}") from None
    return Launched(cluster, sorted(_jobs(cluster) - before, key=int), records, run)


def _jobs(cluster: Cluster) -> set[str]:
    return set(cluster.ask("squeue", "--noheader", "--states=all", "--format=%F").split())


@dataclass
class Restart:
    """One preemption of a training."""

    last_step: int
    """The last step that rank 0 trained before it stopped."""
    first_step: int
    """The first one after it came back."""


@dataclass
class Preempted(Seen):
    """A training that urgent jobs have preempted, compared with the undisturbed one."""

    restarts: list[Restart] = field(default_factory=list)


def preempt(
    calm: Launched, recipe: Path, run: Path, after: Sequence[int], *, ended: Sequence[int] = ()
) -> Preempted:
    """Train anew what `calm` has trained, and have an urgent job take both nodes behind each step of `after`.

    Behind those that are in `ended` too, the processes get a plain SIGTERM instead, as the grace time of a
    preemption begins where SLURM sends no other signal. SLURM takes some seconds to act, in which training
    goes on; a step takes a tenth of a second more here.
    """
    shutil.copytree(calm.run, run, ignore=shutil.ignore_patterns(".slurm"))
    for name in TRAINED:
        shutil.rmtree(run / "stages" / name)
    launched = launch(calm.cluster, recipe, run, pause=0.1)
    for number, step in enumerate(after):
        launched.wait_for_step(step, number)
        if step in ended:
            launched.cluster.ask("scancel", "--signal=TERM", launched.training)
            continue
        launched.cluster.ask(
            "sbatch", "--partition=urgent", "--nodes=2", "--ntasks-per-node=1", "--cpus-per-task=2",
            "--output=/dev/null", "--wrap=sleep 1",
        )  # fmt: skip
    launched.wait_for_step(0, len(after))
    launched.wait_for_end()
    if set(launched.states()) != {"COMPLETED"}:
        raise AssertionError(f"{launched.states()}\n{launched.logs()}")
    return _compared(calm, launched, len(after))


def _compared(calm: Launched, launched: Launched, restarts: int) -> Preempted:
    undisturbed = {(rank, row["step"]): row for rank, row in calm.rows()}
    seen = Preempted("preempted", TRAINED[0], 2, 0, steps=1 + max(step for _, step in undisturbed))
    compare(seen, [launched.records], undisturbed, calm.files(), launched.files())
    mine = [row for rank, row in launched.rows() if rank == 0]
    for number in range(restarts):
        last = [row for row in mine if row["start"] == number][-1]
        first = next(row for row in mine if row["start"] == number + 1)
        seen.restarts.append(Restart(last["step"], first["step"]))
    return seen
