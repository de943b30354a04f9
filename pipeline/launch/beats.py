"""What the processes of a run say of themselves, and when that means that one has died or stalled.

Pure functions of what was heard; `watch.py` listens and acts. Times are seconds by the clock of the process
that counts them, never differences between two machines' clocks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

SILENT = 5.0
"""Seconds without a word after which a process counts as one that does not answer. Words come every second
from a thread of their own, whatever the process computes."""
_UNITS = 10
"""A unit of a divided work may take so many times as long as the longest one of its kind so far."""


@dataclass
class Beat:
    """What a process says of itself, every second."""

    rank: int
    host: str = ""
    pid: int = 0
    birth: str = ""
    """When the process began, as the system counts it: tells it from a later one of the same number."""
    stage: str = ""
    phase: str = ""
    step: int | None = None
    count: int = 0
    """How often it has made progress in this stage; processes that train together count alike."""
    idle: float = 0.0
    """Seconds since it last did."""
    expected: bool = False
    """Whether progress is expected of what it does: a training's steps, its units of a divided work, not a
    conversion or a wait."""
    work: str = ""
    """Which units of a divided work it makes; how long one takes nobody knows before one is made."""
    longest: float = 0.0
    """Seconds of the longest of them that it has made."""

    def name(self) -> str:
        """As a sentence names it."""
        return f"rank {self.rank} on {self.host} (process {self.pid})"

    def place(self) -> str:
        """Where it is, as a sentence says it."""
        step = "" if self.step is None else f", step {self.step}"
        stage = f"stage {self.stage}{step}" if self.stage else "no stage yet"
        return f"{stage}, {self.phase}" if self.phase else stage


@dataclass
class Peer:
    """A process as another one knows it."""

    beat: Beat
    silent: float = 0.0
    """Seconds since it was heard."""
    known: bool = False
    """Whether it has been heard at all."""
    gone: bool = False
    """Its connection is closed."""
    done: bool = False
    """It has said goodbye: nothing is expected of it any more."""
    code: int | None = None
    """The exit code that it has ended with, of an error of its own."""


@dataclass(frozen=True)
class Verdict:
    """Why a run ends."""

    rank: int
    sentence: str
    stalled: bool
    """Whether the process may still be there."""
    mute: bool = False
    """Whether it cannot be expected to end by itself."""
    host: str = field(default="")
    pid: int = 0
    birth: str = ""

    def message(self) -> dict[str, Any]:
        """As it is sent."""
        return asdict(self)


def judge(peers: Sequence[Peer], stall_seconds: float) -> Verdict | None:
    """Whose fault it is that the run must end; None while all is well.

    Processes that train together wait for each other, so when one stalls none makes progress. The one that
    does not answer is to blame, else the one that has done least. 0 `stall_seconds`: none is.

    Processes that divide a work wait for nobody. How long a unit of it takes depends on the network and the
    machine, so there the limit is the longest unit of any process ten times, if that is more.
    """
    here = [peer for peer in peers if peer.known and not peer.done]
    for peer in here:
        if peer.gone and peer.code is None:
            return _verdict(peer, "has died", stalled=False)
    for peer in here:
        if peer.code is not None:
            return _verdict(peer, f"has ended with exit code {peer.code}", stalled=False)
    if not stall_seconds:
        return None
    mute = [peer for peer in here if peer.silent > SILENT]
    if mute:
        peer = max(mute, key=lambda peer: peer.silent)
        if peer.silent <= stall_seconds:
            return None
        what = f"has stalled: it has not answered for {peer.silent:.0f} s"
        return _verdict(peer, what, stalled=True, mute=True)
    waiting = [peer for peer in here if peer.beat.expected]
    if not waiting:
        return None
    peer = min(waiting, key=lambda peer: (peer.beat.count, -peer.beat.idle))
    if peer.beat.idle <= max(stall_seconds, _unit_limit(peer.beat, here)):
        return None
    return _verdict(peer, f"has stalled: no progress for {peer.beat.idle:.0f} s", stalled=True)


def _unit_limit(beat: Beat, here: Sequence[Peer]) -> float:
    """Seconds that what a process does may take for all that is known of it; 0 for a training's step."""
    if not beat.work:
        return 0.0
    longest = max(peer.beat.longest for peer in here if peer.beat.work == beat.work)
    return _UNITS * longest if longest else math.inf


def _verdict(peer: Peer, what: str, *, stalled: bool, mute: bool = False) -> Verdict:
    beat = peer.beat
    limit = " (hardware.stall_seconds)" if stalled else ""
    sentence = (
        f"{beat.name()} {what}{limit}; it was at {beat.place()}. The whole run ends; the same command "
        f"goes on from the newest checkpoint"
    )
    return Verdict(beat.rank, sentence, stalled, mute, beat.host, beat.pid, beat.birth)
