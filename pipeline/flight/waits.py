"""What a training waits for, as shares of its time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


class Waiting(Protocol):
    """Seconds a training has waited since it began, by cause; whoever reads it takes differences."""

    data: float
    checkpoints: float


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
