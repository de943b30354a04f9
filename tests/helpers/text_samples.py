"""A text encoder for tests that need captions, but not what they say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from motionloom.datasets.text.encoder import EncodedText


class OneToken:
    """A text encoder that says the same of everything."""

    name, dim = "one-token", 4

    def encode(self, captions: Sequence[str]) -> EncodedText:
        ones = np.ones((len(captions), 1, 4), dtype=np.float32)
        return EncodedText(ones[:, 0] / 2, ones, np.ones((len(captions), 1), dtype=bool))
