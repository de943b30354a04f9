"""Fixtures of this folder."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from watched_training import Jobs


@pytest.fixture
def jobs() -> Iterator[Jobs]:
    """Starts jobs of two processes; nothing of them outlives the test."""
    started = Jobs()
    yield started
    started.end()
