"""A data set of which some clips lack hands, some a face; garbage of a chosen size is stored there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from shard_samples import write_made

from motionloom.datasets.base.records import FACE, HANDS, Caption, Split
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.sample import Sample

LAYOUT = MotionLayout.named("wholebody363")
COUNT = 24


@dataclass(frozen=True)
class Convert:
    """Clip i holds the bits `present[i % len(present)]`; `garbage` fills the rest."""

    present: tuple[int, ...] = (3, 1, 2, 0, 3)
    garbage: float = 0.0

    def __call__(self, i: int) -> Sample:
        rng = np.random.default_rng(i)
        motion = rng.standard_normal((16 + i, LAYOUT.dim)) * np.linspace(0.5, 2, LAYOUT.dim) + 0.1 * (i % 3)
        bits = self.present[i % len(self.present)]
        missing = ~LAYOUT.present_columns[bits]
        junk = np.random.default_rng(1000 + i).standard_normal((len(motion), int(missing.sum())))
        motion[:, missing] = self.garbage * (1 + junk)
        meta = LAYOUT.clip_meta(
            f"clip{i}", source="made", split="train", frames=len(motion), licence="CC0",
            has_hands=bool(bits & HANDS), has_face=bool(bits & FACE),
        )  # fmt: skip
        texts = [Caption(text=f"a person {i}"), Caption(text="walks")]
        faces = [Caption(text="happy")]
        return Sample(meta, motion.astype(np.float32), texts=texts, face_texts=faces)


def write(out: Path, garbage: float = 0.0, present: tuple[int, ...] = (3, 1, 2, 0, 3)) -> Path:
    items: list[tuple[Split, int]] = [("test" if i % 4 == 3 else "train", i) for i in range(COUNT)]
    return write_made(out, items, Convert(present, garbage), LAYOUT, clips_per_shard=5)
