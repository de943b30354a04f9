"""What a training waits for: seconds in which it computed no step, by their cause, and shares of its time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass
class Waits:
    """Seconds a training has waited since it began, in this process; whoever reads it takes differences."""

    data: float = 0.0
    """For the next batch: what the reader had not prepared while the step before it was computed."""
    checkpoints: float = 0.0
    """For checkpoints: copying the state, and for the one before it where that was still being written."""

    @contextmanager
    def for_data(self) -> Iterator[None]:
        """Count the block as a wait for data."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.data += time.perf_counter() - begin

    @contextmanager
    def for_checkpoints(self) -> Iterator[None]:
        """Count the block as a wait for checkpoints."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.checkpoints += time.perf_counter() - begin


@dataclass
class Waited:
    """Seconds waited since a moment, and those that have gone by."""

    wall: float = 0.0
    data: float = 0.0
    checkpoints: float = 0.0
    ranks: float = 0.0

    def add(self, other: Waited) -> None:
        """Put another stretch behind this one."""
        self.wall += other.wall
        self.data += other.data
        self.checkpoints += other.checkpoints
        self.ranks += other.ranks

    def shares(self) -> dict[str, float]:
        """Of the time that has gone by, 0 to 1, by cause."""
        wall = max(self.wall, 1e-9)
        causes = {"data": self.data, "checkpoints": self.checkpoints, "ranks": self.ranks}
        return {cause: min(1.0, max(0.0, seconds / wall)) for cause, seconds in causes.items()}

    def say(self, *, team: bool) -> str:
        """One line for people; other ranks are named where there are any."""
        shares = self.shares()
        said = [f"{_percent(shares['data'])} for data", f"{_percent(shares['checkpoints'])} for checkpoints"]
        if team:
            said.append(f"{_percent(shares['ranks'])} for other ranks")
        return f"waited {', '.join(said)}"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
