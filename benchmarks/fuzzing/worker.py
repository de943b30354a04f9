"""Reads damaged inputs in a child process, and counts what is no answer: other exceptions than a `UserError`,
more than two seconds, more memory than 20 times the input and 200 MB, a process that dies or never ends.

Input number n of a reader is the same for one seed of the command, so that counts can go on, and what a child
died of can be made again.
"""

from __future__ import annotations

import mmap
import os
import resource
import signal
import struct
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from fuzzing.mutations import damaged_bytes
from fuzzing.table import ROOT, Read, Reader, Seed
from motionloom.datasets.base.errors import UserError

SECONDS, TIMES, SPARE = 2.0, 20, 200 * 2**20
"""CPU seconds, and bytes of memory: so many times the input's and so many more."""
_ADDRESSES = 12 * 2**30
_HANGS = 60.0
"""CPU seconds, or three times as many of doing nothing, after which a child is ended."""
_KEPT = 5
"""Failing inputs of one place that are kept."""
_QUICK = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
"""Memory in place of a disk: some readers wait until what they write is there."""
_ROW = struct.Struct("<qqqqqddd")


@dataclass
class Count:
    """Answers to the inputs of a reader, counted."""

    inputs: int = 0
    refused: int = 0
    taken: int = 0
    unexpected: int = 0
    slow: int = 0
    large: int = 0
    slowest_seconds: float = 0.0
    largest_mb: float = 0.0
    cpu_seconds: float = 0.0
    places: dict[str, int] = field(default_factory=dict)
    """Inputs by what was wrong with them, and where."""

    def add(self, other: Count) -> None:
        for name, value in asdict(other).items():
            own = getattr(self, name)
            if name == "places":
                for place, count in value.items():
                    own[place] = own.get(place, 0) + count
            elif name in ("slowest_seconds", "largest_mb"):
                setattr(self, name, max(own, value))
            else:
                setattr(self, name, own + value)


def damaged(name: str, seeds: list[Seed], seed: int, number: int) -> tuple[Seed, bytes]:
    """Input `number` of a reader, of one seed of the command."""
    random = Random(f"{name} {seed} {number}")
    chosen = random.choice(seeds)
    like = [one for one in seeds if one.damage is chosen.damage]
    other = random.choice(like).content
    try:
        return chosen, chosen.damage(random, chosen.content, other)
    except (
        ArithmeticError,
        ValueError,
        TypeError,
        LookupError,
        RecursionError,
    ):  # of what is damaged already
        return chosen, damaged_bytes(random, chosen.content, other)


class Worker:
    """Reads inputs of one reader in children, one after the other."""

    def __init__(self, reader: Reader, seed: int, failing: Path) -> None:
        self.reader = reader
        self.seed = seed
        self.failing = failing
        self._shared = mmap.mmap(-1, mmap.PAGESIZE)

    def run(self, first: int, count: int, seconds: float = float("inf")) -> Count:
        """Read inputs from number `first` on: `count`, or as many as go into so many CPU seconds."""
        total = Count()
        while total.inputs < count and total.cpu_seconds < seconds:
            with tempfile.TemporaryDirectory(prefix="fuzz-", dir=_QUICK) as folder, _inside(Path(folder)):
                # Seeds are made here, once: a child that died may have left its folder as it was.
                seeds, read = self.reader.make(Path(folder))
                if not seeds or not all(map(_is_changed, seeds)):
                    raise AssertionError(f"{self.reader.name}: no seeds, or one that no mutator changes")
                for seed in seeds:  # that which is whole is read, and what is loaded once is loaded
                    _genuine(self.reader.name, seed, read)
                died = False
                while total.inputs < count and total.cpu_seconds < seconds and not died:
                    at = first + total.inputs
                    left = (count - total.inputs, seconds - total.cpu_seconds)
                    part, died = self._child(seeds, read, at, *left)
                    total.add(part)
        return total

    def _child(
        self, seeds: list[Seed], read: Read, first: int, count: int, seconds: float
    ) -> tuple[Count, bool]:
        """The counts of a child, and whether an input ended it."""
        shared = self._shared
        notes = tempfile.TemporaryFile()  # noqa: SIM115 - open in the child, too
        shared[: _ROW.size] = _ROW.pack(0, 0, 0, 0, 0, 0.0, 0.0, 0.0)
        child = os.fork()
        if child == 0:
            try:
                self._read(seeds, read, first, count, seconds, notes.fileno())
                os._exit(0)
            except BaseException as error:
                os.write(notes.fileno(), f"broken {traceback.format_exc()}{error}".encode())
            finally:
                os._exit(1)
        ended = self._watch(child)
        row = _ROW.unpack(shared[: _ROW.size])
        notes.seek(0)
        found = Count(*row[:5], slowest_seconds=row[5], largest_mb=row[6], cpu_seconds=row[7])
        said = notes.read().decode()
        if "broken " in said:
            raise SystemExit(said)
        for line in said.splitlines():
            kind, _, place = line.partition(" ")
            setattr(found, kind, getattr(found, kind) + 1)
            found.places[place] = found.places.get(place, 0) + 1
        if ended:
            found.inputs = found.inputs + 1
            found.unexpected = found.unexpected + 1
            place = f"process ended by {ended}"
            found.places[place] = found.places.get(place, 0) + 1
            number = first + found.inputs - 1
            self._keep(place, *damaged(self.reader.name, seeds, self.seed, number), number)
        return found, bool(ended)

    def _watch(self, child: int) -> str | int:
        """Wait for a child; the signal by which it ended, or its code, or `hang`."""
        seen = -1
        since = time.monotonic()
        used = 0.0
        while True:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return (
                    signal.Signals(os.WTERMSIG(status)).name
                    if os.WIFSIGNALED(status)
                    else os.WEXITSTATUS(status)
                )
            number = _ROW.unpack(self._shared[: _ROW.size])[0]
            with suppress(OSError, IndexError):
                fields = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
                now = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
                if number != seen:
                    seen = number
                    since = time.monotonic()
                    used = now
                elif now - used > _HANGS or (time.monotonic() - since > 3 * _HANGS and now - used < 0.2):
                    os.kill(child, signal.SIGKILL)
                    os.waitpid(child, 0)
                    return "hang"
            time.sleep(0.05)

    # In the child.

    def _read(
        self, seeds: list[Seed], read: Read, first: int, count: int, seconds: float, notes: int
    ) -> None:
        resource.setrlimit(resource.RLIMIT_AS, (_ADDRESSES, _ADDRESSES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        warnings.simplefilter("ignore")
        counts = [0, 0, 0, 0, 0]
        slowest = largest = 0.0
        began = time.process_time()
        for number in range(first, first + count):
            seed, content = damaged(self.reader.name, seeds, self.seed, number)
            fault, used, grown = _tried(read, seed, content)
            counts[1] += fault == "refused"
            counts[2] += fault == "taken"
            wrong = [("unexpected", fault)] if fault not in ("refused", "taken") else []
            if used > SECONDS:
                wrong.append(("slow", f"slow: {seed.file}"))
            if grown > TIMES * len(content) + SPARE:
                wrong.append(("large", f"large: {seed.file}"))
            for kind, place in wrong:
                os.write(notes, f"{kind} {place}\n".encode("utf-8", "replace"))
                self._keep(place, seed, content, number)
            counts[0] += 1
            slowest = max(slowest, used)
            largest = max(largest, grown / 2**20)
            spent = time.process_time() - began
            self._shared[: _ROW.size] = _ROW.pack(*counts, slowest, largest, spent)
            # The most memory is known for a whole process alone: who follows starts anew.
            if spent > seconds or grown > SPARE / 2:
                return

    def _keep(self, place: str, seed: Seed, content: bytes, number: int) -> None:
        self.failing.mkdir(parents=True, exist_ok=True)
        words = "".join(c if c.isalnum() else "-" for c in f"{self.reader.name} {place}")[:120]
        if len(list(self.failing.glob(f"{words}.*"))) < _KEPT:
            (self.failing / f"{words}.{number}.{Path(seed.file).name}").write_bytes(content)


def _is_changed(seed: Seed) -> bool:
    """Whether the mutator of a seed makes another content of it."""
    for number in range(20):
        with suppress(ArithmeticError, ValueError, LookupError, RecursionError):
            if seed.damage(Random(number), seed.content, seed.content) != seed.content:
                return True
    return False


def _genuine(name: str, seed: Seed, read: Read) -> None:
    try:
        read(seed, seed.content)
    except Exception as error:
        raise AssertionError(f"{name}: its seed {seed.file} is not read: {error}") from error


def _tried(read: Read, seed: Seed, content: bytes) -> tuple[str, float, int]:
    """`refused`, `taken` or what was wrong and where; CPU seconds; bytes that the process has grown by."""
    most = _peak()
    here = _size()
    began = time.process_time()
    try:
        read(seed, content)
        fault = "taken"
    except UserError as error:
        fault = (
            "refused"
            if str(error) and str(error).count("\n") < 20
            else f"a sentence of {len(str(error))} letters"
        )
    except BaseException as error:
        fault = _place(error)
    used = time.process_time() - began
    peak = _peak()
    return fault, used, max(0, peak - here) if peak > most else 0


@contextmanager
def _inside(folder: Path) -> Iterator[None]:
    """The current folder, to which names without a folder lead."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def _place(error: BaseException) -> str:
    """Kind of an exception, and the last line of the package that it came from."""
    frames = [
        frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(str(ROOT))
    ]
    inside = [frame for frame in frames if "/benchmarks/" not in frame.filename] or frames
    where = f"{Path(inside[-1].filename).relative_to(ROOT)}:{inside[-1].lineno}" if inside else "?"
    return f"{type(error).__name__} {where}" + (
        f" {str(error)[:80]!r}" if isinstance(error, AssertionError) else ""
    )


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _size() -> int:
    return int(Path("/proc/self/statm").read_bytes().split()[1]) * mmap.PAGESIZE


def as_record(count: Count) -> dict[str, Any]:
    """The counts as plain JSON, numbers rounded."""
    facts = asdict(count)
    return {key: round(value, 2) if isinstance(value, float) else value for key, value in facts.items()}
