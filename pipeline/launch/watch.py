"""A thread in every process of a run that ends the run when one of them dies or stalls.

Collectives do not do that by themselves: NCCL may wait for a dead process for ever, gloo waits half an hour
for a stopped one, and a process that converts data for hours notices nobody's death at all.

Every process keeps a connection of its own to the lead (rank 0) and says every second where it is
(`beats.Beat`). The lead judges them all, the others the lead. A closed connection is a death and ends the run
within seconds; silence, or a training or a divided work without progress, is a stall, and ends it after
`hardware.stall_seconds`. Then one process prints one sentence, after a stall each writes the stacks of its
threads to `flight/stacks_rank_N.txt` in the stage's folder, a process of the same machine that does not
answer is killed, children are, and all end with `ENDED`. A training in one process is watched for stalls
likewise.

Connections and not files in the run folder: shared file systems show a file's change up to a minute late, and
do not tell a dead process from a slow disk. Where the connection cannot be made the run goes on without.

A process that was itself stopped for a while counts none of that time.
"""

from __future__ import annotations

import faulthandler
import hmac
import os
import secrets
import select
import socket
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from motionloom.pipeline.launch.beats import Beat, Peer, Verdict, judge
from motionloom.pipeline.launch.ending import birth_of, kill_children, kill_stopped
from motionloom.pipeline.launch.lines import Line
from motionloom.pipeline.launch.process import local_rank

ENDED = 76
"""Exit code of a process that ends because another one has died, or because one has stalled."""

TICK = 1.0
_GRACE = 3.0
"""Seconds in which processes may end in their own way, and write their stacks."""
_CONNECT = 20.0
_ASKED_TO = (0, 75, 130)
"""Exit codes of processes that end because their work is done, because all were asked to save and stop, or
because of Ctrl-C: the others have their own word about that.
"""
FLIGHT = "flight"
"""Folder of what is written when a stage ends badly, within the stage's."""


class Watch:
    """This process among those of a run, and what it hears of the others.

    Args:
        rank: Of this process.
        stall_seconds: Of the recipe; 0 looks for deaths alone.
        end: Ends this process with an exit code.
    """

    def __init__(self, rank: int, stall_seconds: float, end: Callable[[int], object] = os._exit) -> None:
        pid = os.getpid()
        self.rank, self.stall_seconds = rank, stall_seconds
        self.beat = Beat(rank, socket.gethostname(), pid, birth_of(pid))
        self.folder: Path | None = None
        self.verdict: Verdict | None = None
        self.grace = _GRACE
        self._noted = 0
        """How often something was noted."""
        self._end = end
        self._judged, self._over = threading.Event(), threading.Event()
        self._listener: socket.socket | None = None
        self._token = ""
        self._strangers: list[Line] = []
        self._lines: dict[int, Line] = {}
        self._peers: dict[int, Peer] = {}
        self._thread: threading.Thread | None = None

    def listen(self, host: str) -> tuple[str, int, str]:
        """The lead's: take connections; the address and the password that the others need."""
        inside = host in {"127.0.0.1", "localhost", "::1"}
        self._listener = socket.create_server(("127.0.0.1" if inside else "", 0), backlog=1024)
        self._listener.setblocking(False)
        self._token = secrets.token_hex(16)
        return "127.0.0.1" if inside else host, int(self._listener.getsockname()[1]), self._token

    def connect(self, host: str, port: int, token: str) -> None:
        """The others': connect to the lead; where that fails deaths and stalls are noticed later."""
        try:
            line = Line(socket.create_connection((host, port), timeout=_CONNECT))
        except OSError as error:
            warnings.warn(
                f"rank {self.rank} cannot reach rank 0 at {host}:{port} ({error}): if a process of this run "
                f"stalls, only the time-outs of the collectives end it",
                stacklevel=2,
            )
            return
        line.send({"token": token, "rank": self.rank})
        self._lines[0] = line
        self._peers[0] = Peer(Beat(0))

    def start(self) -> Watch:
        """Begin to watch, in a thread."""
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)
        self._thread.start()
        return self

    def enter_stage(self, name: str, folder: Path, phase: str) -> None:
        """A stage begins."""
        self.folder = folder
        self.beat.stage, self.beat.step, self.beat.count = name, None, 0
        self.beat.work, self.beat.longest = "", 0.0
        self.rest(phase)

    def progress(self, phase: str, step: int | None = None, *, alike: bool = True) -> None:
        """Something was done, and more is expected; `phase` says what is done now, and `alike` whether all
        processes that train together say the same.
        """
        if step is not None:
            self.beat.step = step
        self.beat.phase, self.beat.expected, self.beat.work = phase, True, ""
        self.beat.count += alike
        self._noted += 1

    @contextmanager
    def unit(self, work: str, phase: str) -> Iterator[None]:
        """Make one unit of a `work` that the processes divide; they are to make the others."""
        if work != self.beat.work:
            self.beat.longest = 0.0
        self.progress(phase, alike=False)
        self.beat.work = work
        begin = time.monotonic()
        yield
        self.beat.longest = max(self.beat.longest, time.monotonic() - begin)

    def rest(self, phase: str) -> None:
        """From now on no progress is expected, as nobody can tell how long this takes."""
        self.beat.phase, self.beat.expected = phase, False
        self._noted += 1

    def stop(self, code: int = 0, *, victim: bool = False) -> None:
        """Say goodbye: this process ends, well or of an error of its own, or as the `victim` of another's."""
        if self._over.is_set():
            return
        self._over.set()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(timeout=2 * TICK)
        self._say({"bye": 0 if victim else code})
        for line in [*self._lines.values(), *self._strangers]:
            line.close()
        if self._listener is not None:
            self._listener.close()

    def explanation(self, seconds: float = 3.0) -> str | None:
        """Why the run ends, once that is known; None if it is not within so many seconds."""
        if self._thread is None or not self._peers:
            return None
        self._judged.wait(seconds)
        return self.verdict.sentence if self.verdict is not None else None

    def _run(self) -> None:
        before, said, noted = time.monotonic(), -TICK, -1
        while not self._over.is_set():
            self._wait()
            if self._over.is_set():
                return
            now = time.monotonic()
            gap, before = min(now - before, 2 * TICK), now
            self.beat.idle = 0.0 if self._noted != noted else self.beat.idle + gap
            noted = self._noted
            self._hear(gap)
            heard = self.verdict is not None
            self.verdict = self.verdict or judge(self._parties(), self.stall_seconds)
            if self.verdict is not None:
                # Where the lead cannot speak, rank 1 does, and one process of each other machine.
                speaks = self.rank == 0 or (not heard and (self.rank == 1 or local_rank() == 0))
                self._finish(self.verdict, speaks)
                return
            if now - said >= TICK:
                self._say({"beat": vars(self.beat)})
                said = now

    def _parties(self) -> list[Peer]:
        """Whom this process judges. Who is connected to the lead leaves all but the lead's silence to it: it
        alone knows who stopped first.
        """
        if self.rank and self._peers:
            lead = self._peers[0]
            return [replace(lead, beat=replace(lead.beat, expected=False))]
        return [Peer(self.beat, known=True), *self._peers.values()]

    def _wait(self) -> None:
        """Until something is to be read, at most a tick."""
        lines: list[Any] = [line for line in (*self._lines.values(), *self._strangers) if not line.closed]
        if self._listener is not None:
            lines.append(self._listener)
        if not lines:
            self._over.wait(TICK)
            return
        with suppress(OSError, ValueError):
            select.select(lines, [], [], TICK)

    def _hear(self, gap: float) -> None:
        if self._listener is not None:
            self._welcome(self._listener)
        for rank, line in self._lines.items():
            peer = self._peers[rank]
            peer.silent += gap
            for message in line.receive():
                peer.silent, peer.known = 0.0, True
                self._take(peer, message)
            peer.gone = line.closed

    def _take(self, peer: Peer, message: dict[str, Any]) -> None:
        if "beat" in message:
            with suppress(TypeError):  # of a process of another version
                peer.beat = Beat(**message["beat"])
        elif "bye" in message:
            peer.done = message["bye"] in _ASKED_TO
            peer.code = None if peer.done else message["bye"]
        elif "verdict" in message and self.verdict is None:
            with suppress(TypeError):
                self.verdict = Verdict(**message["verdict"])

    def _welcome(self, listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                self._strangers.append(Line(listener.accept()[0]))
        for line in [*self._strangers]:
            messages = line.receive()
            if not messages and not line.closed:
                continue
            self._strangers.remove(line)
            first = messages[0] if messages else {}
            rank = first.get("rank")
            if hmac.compare_digest(str(first.get("token")), self._token) and isinstance(rank, int):
                self._lines[rank], self._peers[rank] = line, Peer(Beat(rank), known=True)
                for message in messages[1:]:
                    self._take(self._peers[rank], message)
            else:
                line.close()

    def _say(self, message: dict[str, Any]) -> None:
        for line in self._lines.values():
            line.send(message)

    def _finish(self, verdict: Verdict, speaks: bool) -> None:
        """End this process, after a moment in which it may end by itself."""
        self._say({"verdict": verdict.message()})
        if speaks:
            with suppress(OSError):
                print(f"error: {verdict.sentence}", file=sys.stderr, flush=True)
        self._judged.set()
        if verdict.stalled:
            with suppress(OSError):
                self._write_stacks()
        if self._over.wait(self.grace):
            return
        if verdict.mute and verdict.rank != self.rank and verdict.host == self.beat.host:
            kill_stopped(verdict.pid, verdict.birth)
        kill_children()
        self._end(ENDED)

    def _write_stacks(self) -> None:
        if self.folder is None or not self.folder.is_dir():
            return
        (self.folder / FLIGHT).mkdir(exist_ok=True)
        with (self.folder / FLIGHT / f"stacks_rank_{self.rank}.txt").open("w") as file:
            faulthandler.dump_traceback(file, all_threads=True)


_current: Watch | None = None


def current() -> Watch | None:
    """The watch of this process, if one runs."""
    return _current


def unit(work: str, index: int, count: int) -> AbstractContextManager[None]:
    """Have this process's watch, if one runs, know that it makes unit `index` of the `count` of a work."""
    if _current is None:
        return nullcontext()
    return _current.unit(work, f"making unit {index + 1} of {count} ({work})")


def begin(watch: Watch) -> Watch:
    """Start a watch and make it this process's."""
    global _current
    end()
    _current = watch.start()
    return watch


def end(code: int = 0, *, victim: bool = False) -> None:
    """Stop this process's watch, if one runs: nobody is to wait for this process any more."""
    global _current
    watch, _current = _current, None
    if watch is not None:
        watch.stop(code, victim=victim)
