"""What a training waits for: seconds that a step was not computing, by their cause."""

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
