"""Trainings that are killed with SIGKILL at random moments, compared step by step with undisturbed ones.

One process imports everything once and forks each try, so a kill falls into the training and not into
imports, and hundreds of them take minutes. A try is the command line, `motionloom run RECIPE --out RUN
--until STAGE`, in each of its ranks, whose every step leaves a line (`step_records.py`).

    python tests/helpers/kill_matrix.py REQUEST.json

does the tries of one or several cells (`Cell`) and writes what was seen beside REQUEST.json. The program
runs this file, and the tests and `benchmarks/reliability.py` start it by `run_cells`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from step_records import RECORDS, rows_of, watch_steps

PRELOADED = (
    "motionloom",
    "motionloom.pipeline.runs.api",
    "motionloom.pipeline.training.trainer",
    "s3fs",  # fsspec imports it to learn that a folder is none of S3's
)


@dataclass(frozen=True)
class Cell:
    """One cell of the matrix: a stage of a finished run that is trained anew, with kills."""

    name: str
    recipe: str
    base: str
    """A run folder in which all that the stage needs is finished; it is copied, not changed."""
    stage: str
    ranks: int = 1
    workers: int = 0
    kills: int = 20
    settings: tuple[str, ...] = ()

    def words(self, run: Path, *, workers: int | None = None) -> list[str]:
        """The command."""
        sets = [*self.settings, f"hardware.workers={self.workers if workers is None else workers}"]
        overrides = [word for setting in sets for word in ("--set", setting)]
        return ["motionloom", "run", self.recipe, "--out", str(run), "--until", self.stage, *overrides]


@dataclass
class Seen:
    """What a cell has shown."""

    name: str
    stage: str
    ranks: int
    workers: int
    steps: int = 0
    kills: int = 0
    in_a_write: int = 0
    """Kills while a checkpoint was half written, by the file that they left."""
    repeated: int = 0
    """Steps of rank 0 that were trained more than once."""
    wrong_samples: int = 0
    """Steps, of all ranks and tries, whose batch had other bytes than in the undisturbed run."""
    wrong_losses: int = 0
    """Steps in which any loss or figure had other bits."""
    missing: int = 0
    """Steps that no try has trained to the end."""
    unequal: tuple[str, ...] = ()
    """Files of the finished stage with other bytes."""

    @property
    def exact(self) -> bool:
        """Nothing differs."""
        return not (self.wrong_samples or self.wrong_losses or self.missing or self.unequal)


def run_cells(cells: Sequence[Cell], work: Path, *, timeout: float | None = None) -> list[Seen]:
    """Do the tries of `cells` in one child process, in folders below `work`."""
    work.mkdir(parents=True, exist_ok=True)
    request = work / "request.json"
    request.write_text(json.dumps([dataclasses.asdict(cell) for cell in cells]))
    path = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(Path(__file__).parent)]))
    done = subprocess.run(
        [sys.executable, "-P", __file__, str(request)],
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": path},
        timeout=timeout,
    )
    if done.returncode != 0:
        raise RuntimeError(f"{__file__} {request} ended with {done.returncode}")
    return [read_seen(work / f"{cell.name}.json") for cell in cells]


def read_seen(path: Path) -> Seen:
    """What a cell has left."""
    content = json.loads(path.read_text())
    return Seen(**{**content, "unequal": tuple(content["unequal"])})


class Try:
    """The ranks of one start of a command, forked, in a process group of their own."""

    def __init__(self, words: list[str], ranks: int, records: Path, log: Path) -> None:
        records.mkdir(parents=True)
        self.records = records
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        job = {"WORLD_SIZE": ranks, "LOCAL_WORLD_SIZE": ranks}
        job |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        self.pids: list[int] = []
        for rank in range(ranks):
            place = {RECORDS: records}
            if ranks > 1:  # as torchrun starts them
                place |= {"RANK": rank, "LOCAL_RANK": rank, "GROUP_RANK": 0, **job}
            pid = os.fork()
            group = self.pids[0] if self.pids else 0
            if not pid:
                _become(words, group, {key: str(value) for key, value in place.items()}, log)
            os.setpgid(pid, group or pid)  # by both: the group is there for whoever comes first
            self.pids.append(pid)

    def running(self) -> bool:
        """Whether no rank has ended."""
        return all(
            os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None for pid in self.pids
        )

    def wait(self) -> list[int]:
        """The ranks' exit codes, once all have ended."""
        return [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in self.pids]

    def kill(self) -> bool:
        """SIGKILL to all; whether it found them running."""
        with suppress(ProcessLookupError):
            os.killpg(self.pids[0], signal.SIGKILL)
        return self.wait() == [-signal.SIGKILL] * len(self.pids)

    def last_step(self) -> int:
        """The newest step of rank 0; -1 before the first."""
        try:
            lines = (self.records / "0.jsonl").read_bytes().splitlines()
        except FileNotFoundError:
            return -1
        return int(json.loads(lines[-1])["step"]) if lines else -1


def _become(words: list[str], group: int, place: dict[str, str], log: Path) -> None:
    """The rest of a forked rank's life."""
    code = 1
    try:
        os.setpgid(0, group)
        os.environ.update(place)
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        sys.argv = words
        from motionloom.pipeline.cli.main import main as program

        program()
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def finished_files(stage: Path) -> dict[str, str]:
    """sha256 of all that a finished stage keeps, but times and checkpoints."""
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(stage.iterdir())
        if path.suffix in {".safetensors", ".jsonl"} or path.name in {"artifact.json", "model.json"}
    }


def copy_without(base: Path, run: Path, stage: str) -> None:
    """A run folder like `base` in which `stage` has not begun."""
    shutil.copytree(base, run, ignore=shutil.ignore_patterns("checkpoints", ".lock"))
    shutil.rmtree(run / "stages" / stage, ignore_errors=True)


def undisturbed(cell: Cell, work: Path) -> tuple[dict[tuple[int, int], dict[str, Any]], dict[str, str]]:
    """{(rank, step): line} and the files of the stage, trained at one go without loader workers."""
    place = work / f"calm-{cell.stage}-{cell.ranks}"
    run, records = place / Path(cell.base).name, place / "records"
    stage = run / "stages" / cell.stage
    if not (stage / "artifact.json").exists():
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        copy_without(Path(cell.base), run, cell.stage)
        codes = Try(cell.words(run, workers=0), cell.ranks, records, place / "log").wait()
        if any(codes):
            raise RuntimeError(f"{place / 'log'}: ended with {codes}")
    return {(rank, row["step"]): row for rank, row in rows_of(records)}, finished_files(stage)


def into_a_write(attempt: Try, folder: Path) -> bool:
    """Stop all ranks while a checkpoint is half written, however slow or busy the machine is."""
    while attempt.running():
        if any(folder.glob(".*.tmp")):
            os.killpg(attempt.pids[0], signal.SIGSTOP)
            os.waitpid(attempt.pids[0], os.WUNTRACED)  # rank 0 stands still
            if any(folder.glob(".*.tmp")):
                return True
            os.killpg(attempt.pids[0], signal.SIGCONT)
        time.sleep(0.0003)
    return False


def kill_and_compare(cell: Cell, work: Path) -> Seen:
    """Train the stage of `cell` through its kills to the end, and compare."""
    calm, files = undisturbed(cell, work)
    steps = 1 + max(step for _, step in calm)
    seen = Seen(cell.name, cell.stage, cell.ranks, cell.workers, steps)
    chance = random.Random(cell.name)
    place = work / cell.name
    shutil.rmtree(place, ignore_errors=True)
    run = place / Path(cell.base).name
    place.mkdir(parents=True)
    copy_without(Path(cell.base), run, cell.stage)
    stage, log = run / "stages" / cell.stage, place / "log"
    # The first kill comes before a step; of the others every fourth comes into a write.
    moments = [-1, *sorted(chance.sample(range(steps - 8), cell.kills - 1))]
    attempts = []
    for number, moment in enumerate(moments):
        attempt = Try(cell.words(run), cell.ranks, place / f"try{number:02d}", log)
        attempts.append(attempt.records)
        if moment < 0:
            time.sleep(chance.uniform(0, 0.3))
        else:
            while attempt.last_step() < moment and attempt.running():
                time.sleep(0.002)
            if number % 4 == 2:
                into_a_write(attempt, stage / "checkpoints")
            else:
                time.sleep(chance.uniform(0, 0.05))
        if not attempt.kill() or (stage / "artifact.json").exists():
            raise RuntimeError(f"{log}: try {number} ended before it was killed")
        seen.kills += 1
        seen.in_a_write += any(stage.glob("checkpoints/.*.tmp"))
    last = Try(cell.words(run), cell.ranks, place / "last", log)
    attempts.append(last.records)
    codes = last.wait()
    if any(codes):
        raise RuntimeError(f"{log}: the last try ended with {codes}")
    compare(seen, attempts, calm, files, finished_files(stage))
    if seen.exact:
        shutil.rmtree(run)
    return seen


def compare(
    seen: Seen,
    attempts: Sequence[Path],
    calm: dict[tuple[int, int], dict[str, Any]],
    files: dict[str, str],
    found: dict[str, str],
) -> None:
    """Note in `seen` what differs of the steps in the records of `attempts`, and of the files."""
    trained: list[tuple[int, int]] = []
    for records in attempts:
        for rank, row in rows_of(records):
            trained.append((rank, row["step"]))
            expected = calm[trained[-1]]
            seen.wrong_samples += row["batch"] != expected["batch"]
            seen.wrong_losses += row["figures"] != expected["figures"]
    seen.missing = len(set(calm) - set(trained))
    mine = [step for rank, step in trained if rank == 0]
    seen.repeated = len(mine) - len(set(mine))
    names = sorted(set(files) | set(found))
    seen.unequal = tuple(name for name in names if files.get(name) != found.get(name))


def main() -> None:
    """The tries of the cells that a request names; those that have been done are passed over."""
    request = Path(sys.argv[1])
    for name in PRELOADED:
        with suppress(ImportError):
            importlib.import_module(name)
    from motionloom.pipeline.contract.stage import stage_kinds

    stage_kinds()
    watch_steps()
    for asked in json.loads(request.read_text()):
        cell = Cell(**{**asked, "settings": tuple(asked["settings"])})
        out = request.parent / f"{cell.name}.json"
        if out.exists():
            continue
        seen = kill_and_compare(cell, request.parent)
        partial = out.with_suffix(".part")
        partial.write_text(json.dumps(dataclasses.asdict(seen)))
        partial.replace(out)
        print(seen, flush=True)


if __name__ == "__main__":
    main()
