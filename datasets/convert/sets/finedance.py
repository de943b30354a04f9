"""FineDance: dances with fingers, motion/NNN.npy [T, 315] at 30 fps = translation 3, 52 rotations of 6.

The rotations are SMPL-X's without jaw and eyes, as the first two rows of their matrices, for the neutral
shape. `music_wav/NNN.wav` is the music, `label_json/NNN.json` says its name, style and genre.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import numpy as np

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import is_file
from motionloom.datasets.base.records import Split
from motionloom.datasets.base.register import register
from motionloom.datasets.convert.common.arrays import check_array_header, load_array
from motionloom.datasets.convert.common.facts import Fact
from motionloom.datasets.convert.common.files import files_in
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.release import Entry, Figure, ReleaseClip
from motionloom.datasets.convert.common.splits import hash_share
from motionloom.datasets.convert.common.tables import captions_of, read_json, require_record
from motionloom.datasets.convert.sets.vectors import rotvecs_of_rows
from motionloom.datasets.convert.smpl.body import SOURCE_FPS, BodyConfig, BodyRelease

JOINTS = 52
WIDTH = 3 + 6 * JOINTS
MOTION = "motion"
MUSIC = "music_wav"
LABELS = "label_json"

_UNPAIRED = frozenset({116, 117, 118, 119, 120, 121, 122, 123, 130, 202})
"""Numbers that the authors' own code leaves out."""
_TEST = {
    "genre": {12, 36, 37, 63, 65, 92, 98, 109, 120, 130, 132, 137, 143, 144, 161, 179, 193, 198, 204, 211},
    "dancer": {*range(1, 14), 124, 126, 128, 130, 132},
}  # fmt: skip
_VAL = {"dancer": {115, 117, 119, 121, 122, 135, 137, 139, 141, 143, 145, 147}}


class FineDanceConfig(BodyConfig):
    """Options of the FineDance converter; `source` is the folder that holds motion/."""

    name: str = "finedance"
    layout: str = "wholebody313"
    """`wholebody313` with fingers, `body133`, an h3d layout, or `smpl75` for UDE."""
    fps: float = 30.0
    split: Literal["genre", "dancer"] = "genre"
    """The authors' split: test dances of many genres, or by dancers of whom nothing else is seen."""
    val_share: float = 0.05
    """With `split: genre`, the share of the training dances for validation, by a hash: it has none."""
    caption_genre: bool = False
    """Give every clip the caption "a dancer performs ...", by its label."""


class FineDance(BodyRelease[FineDanceConfig]):
    """The FineDance converter."""

    name = "finedance"
    title = "FineDance"
    summary = "FineDance: whole-body dances with their music to shards."
    example = "FineDance/data shards"
    config_class = FineDanceConfig
    terms = "FineDance-noncommercial"
    model = "SMPL-X"
    published = "README (the part to download): 211 clips, 7.7 hours"

    def entries(self, draft: ConversionPlan[ReleaseClip]) -> Iterable[Entry]:
        source = self.config.source
        if not (source / MOTION).is_dir():
            raise UserError(f"{source}: no {MOTION}/ in it; give the folder data/ of the release")
        for name in files_in(source / MOTION, ".npy"):
            number = name.removesuffix(".npy")
            facts: dict[str, Fact] = {}
            label = f"{LABELS}/{number}.json"
            with draft.reading(label):
                if is_file(source / label):
                    stated = require_record(read_json(source / label, label), label)
                    facts = {
                        key: str(value) for key, value in stated.items() if not isinstance(value, dict | list)
                    }
            genre = next(
                (str(facts[key]) for key in ("style2", "genre", "style1", "style") if key in facts), ""
            )
            sound = f"{MUSIC}/{number}.wav"
            yield Entry(
                number,
                f"{MOTION}/{name}",
                tuple(
                    captions_of(f"a dancer performs {genre}", "genre")
                    if genre and self.config.caption_genre
                    else ()
                ),
                self._split(number),
                facts=facts,
                sound=sound if is_file(source / sound) else None,
                problem="on the authors' list of unusable dances" if _is(number, _UNPAIRED) else "",
            )

    def _split(self, number: str) -> Split:
        kind = self.config.split
        if _is(number, _TEST[kind]):
            return "test"
        if kind in _VAL:
            return "val" if _is(number, _VAL[kind]) else "train"
        return "val" if hash_share(number) < self.config.val_share else "train"

    def length(self, path: Path, label: str) -> tuple[int, float]:
        return check_array_header(path, width=WIDTH, name=label), SOURCE_FPS

    def figure(self, clip: ReleaseClip) -> Figure:
        label = clip.entry.file
        values = load_array(self.path_of(label), width=WIDTH, name=label, limit=_LIMITS).astype(np.float64)
        rotations = rotvecs_of_rows(values[:, 3:].reshape(len(values), JOINTS, 6), label)
        return Figure(rotations=rotations, trans=values[:, :3])


_LIMITS = np.concatenate([np.full(3, 1e3), np.full(6 * JOINTS, 10.0)])
"""Metres, and columns of rotation matrices, which networks may leave a little beyond 1."""


def _is(number: str, listed: Iterable[int]) -> bool:
    return (number.lstrip("0") or "0") in map(str, listed)


register(FineDance)
