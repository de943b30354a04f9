"""Seeds of samples."""

from __future__ import annotations

import numpy as np


def sample_seeds(seed: int, count: int) -> list[int]:
    """One independent seed per sample; the first n are the same whatever `count` is."""
    return [
        int(np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)[0]) for index in range(count)
    ]
