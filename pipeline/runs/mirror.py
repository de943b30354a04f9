"""`motionloom run --mirror s3://bucket/run`: what of a run must not be lost with its machine, in a bucket.

Every finished stage and each checkpoint is put there in the background. A machine with an empty disk begins
by fetching what its stages need, and goes on with the same bytes. A training's folder there is, at any
moment, of one `started.json`: what others have left goes before it comes, and a checkpoint that is rotated
away goes behind the newer one. `artifact.json` comes last and goes first, here and there.

Of several machines, each with a disk of its own, the lead's sends; the others take from there what a stage
reads and the checkpoint that a training goes on from, and put there what they have made of a shared stage.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of, temporary_folder
from motionloom.datasets.base.lock import LOCK_FILE, file_lock
from motionloom.datasets.shards.store import open_store, read_stored
from motionloom.pipeline.contract.units import WORK
from motionloom.pipeline.launch.console import say
from motionloom.pipeline.launch.process import local_rank, process_rank
from motionloom.pipeline.launch.team import Team
from motionloom.pipeline.store.artifact import FILE_NAME
from motionloom.pipeline.store.files import remove_tree
from motionloom.pipeline.training.checkpointing import step_of

STARTED = "started.json"
_PASSING = {"checkpoints", "flight", "samples"}
"""What a finished stage has no need of."""
_LAST = (STARTED, FILE_NAME)


class Mirror:
    """The mirror of one run. As a context it ends when all that was due lies there.

    `team` are the processes of the run where these are on several machines, `devices` of them on each.
    """

    def __init__(
        self, place: str, run: Path, console: Console, team: Team | None = None, devices: int = 1
    ) -> None:
        self.store = open_store(place)
        if self.store.place.startswith("http"):
            raise UserError(f"{place}: a web server is only read; name a bucket or a folder")
        self._run = run
        self._console = console
        self._threads = ThreadPoolExecutor(1)
        self._due: set[str] = set()
        self._sent: dict[str, Future[None]] = {}
        self.team = team
        self._follows = team is not None and team.rank >= devices and local_rank() == 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._threads.shutdown()
        if error is None:
            self._flush()

    def _flush(self) -> None:
        """Wait until all that was due lies there."""
        failed = next(filter(None, [sent.exception() for sent in self._sent.values()]), None)
        if failed is not None:
            raise UserError(f"{failed}; the run is whole in {self._run}: the same command sends the rest")

    def fetch(self, stages: Sequence[str]) -> None:
        """Fetch stages that are further there than here, unless they are begun here with other settings."""
        self._run.mkdir(parents=True, exist_ok=True)
        if self.team is None or self.team.leads:
            with file_lock(self._run / LOCK_FILE):  # all processes of the machine ask for it
                for stage in stages:
                    self._fetch(f"stages/{stage}")
        self.spread(stages)

    def spread(self, stages: Sequence[str]) -> None:
        """Have all machines hold what the lead's has of some stages; all processes call it."""
        if self.team is None:
            return
        if self.team.leads:
            for stage in stages:
                if (self._run / "stages" / stage / STARTED).exists():
                    self.send(stage)
            self._flush()
        self.team.meet()
        if self._follows:
            for stage in stages:
                self._follow(f"stages/{stage}")
        self.team.meet()

    def collect(self, stage: str) -> None:
        """Have the lead's machine hold the units of a shared stage that others have made; all call it."""
        if self.team is None:
            return
        self.team.meet()
        work = f"stages/{stage}/{WORK}/"
        if self._follows:
            for path in sorted((self._run / work).glob("*.npz")):
                self.store.put(path, work + path.name, sha256_of(path))
        self.team.meet()
        if self.team.leads:
            for name in self.store.names(work):
                if not (self._run / work / name.removeprefix(work)).exists():
                    self.store.get(name, self._run / name)

    def _follow(self, folder: str) -> None:
        """Make this machine's folder of a stage what the lead has sent of it."""
        here = self._run / folder
        there = self.store.names(folder)
        last = f"{folder}/{FILE_NAME if f'{folder}/{FILE_NAME}' in there else STARTED}"
        if last not in there:
            if not (here / FILE_NAME).exists():
                remove_tree(here)
            return
        mine = self._run / last
        is_finished = (here / FILE_NAME).exists()
        if mine.exists() and mine.read_bytes() == read_stored(self.store, last):
            checkpoints = map(str, here.glob("checkpoints/*"))
            as_far = not is_finished and _newest(checkpoints) == _newest(there)
            if mine.name == FILE_NAME or as_far:
                return
        remove_tree(here)
        self._fetch(folder)

    def _fetch(self, folder: str) -> None:
        here = self._run / folder
        if (here / FILE_NAME).exists():
            return
        there = [name.removeprefix(f"{folder}/") for name in self.store.names(folder)]
        if STARTED not in there:
            return
        begun = here / STARTED
        if begun.exists():
            mine = [path.name for path in here.glob("checkpoints/*")]
            is_newer = FILE_NAME in there or _newest(there) > _newest(mine)
            if not is_newer or begun.read_bytes() != read_stored(self.store, f"{folder}/{STARTED}"):
                return
        say(self._console, f"{self._run}: {folder} is fetched from {self.store.place}")
        for name in sorted(there, key=_order):
            self.store.get(f"{folder}/{name}", here / name)

    def send(self, stage: str) -> None:
        """Have the state of a stage put there soon, where this process leads."""
        if process_rank() == 0 and stage not in self._due:
            self._due.add(stage)
            self._sent[stage] = self._threads.submit(self._send, stage)

    def _send(self, stage: str) -> None:
        self._due.discard(stage)
        prefix = f"stages/{stage}/"
        (self._run / ".mirror").mkdir(exist_ok=True)
        with temporary_folder(self._run / ".mirror") as kept:
            files = _stage_files(self._run / prefix, kept)
            sums = {name: sha256_of(files[name]) for name in sorted(files, key=_order)}
            there = [name.removeprefix(prefix) for name in self.store.names(prefix)]
            gone = sorted({*there} - {*files}, key=_order, reverse=True)
            is_same = self.store.digest(prefix + STARTED) == sums.get(STARTED)
            for name in () if is_same else gone:
                self.store.remove(prefix + name)
            if FILE_NAME in sums and self.store.digest(prefix + FILE_NAME) == sums[FILE_NAME]:
                return
            for name, digest in sums.items():
                if self.store.digest(prefix + name) != digest:
                    self.store.put(files[name], prefix + name, digest)
            for name in gone if is_same else ():
                self.store.remove(prefix + name)


def _stage_files(stage: Path, kept: Path) -> dict[str, Path]:
    """The files of a stage that are needed elsewhere: of a finished one its own, else the newest checkpoint.

    What may be replaced or rotated away meanwhile has a second name in the folder `kept`.
    """
    found = [path for path in stage.rglob("*") if path.is_file() and path.name[0] != "."]
    names = {path.relative_to(stage).as_posix(): path for path in found}
    if FILE_NAME in names:
        return {name: path for name, path in names.items() if name.split("/")[0] not in _PASSING}
    newest = sorted(name for name in names if step_of(names[name]) is not None)[-1:]
    for name in (*newest, STARTED):
        with suppress(FileNotFoundError):  # the newer one is due
            (kept / Path(name).name).hardlink_to(stage / name)
    return {name: kept / Path(name).name for name in (*newest, STARTED) if (kept / Path(name).name).exists()}


def _newest(names: Iterable[str]) -> int:
    return max((step_of(Path(name)) or 0 for name in names), default=0)


def _order(name: str) -> int:
    return _LAST.index(name) + 1 if name in _LAST else 0
