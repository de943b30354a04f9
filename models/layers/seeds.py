"""Seeds of samples."""

from __future__ import annotations

import numpy as np

FACES = 1
"""A purpose: what is drawn for the face of a motion."""


def sample_seeds(seed: int, count: int, *purpose: int) -> list[int]:
    """One independent seed per sample, and per `purpose`; the first n are the same whatever `count` is."""
    numbers = ([seed, index, *purpose] for index in range(count))
    return [int(np.random.SeedSequence(own).generate_state(1, np.uint64)[0]) for own in numbers]
