"""SnapMoGen: long descriptions of motions at 30 fps, renamed_feats/NAME.npy [T, 296].

| columns | content |
|---|---|
| 0 | turn of the heading to the next frame, radians |
| 1:3, 3 | step of the root to the next frame, x and z, seen from this frame's heading; its height |
| 4:148 | 24 rotations in six columns, of the world but for the heading |
| 148:220 | 24 joints above the origin, seen from the heading, in the character's centimetres |
| 220:296 | their steps and four foot contacts |

Joints are read from the positions. `all_caption_clean.json` has a record for `NAME#FIRST#LAST` (frames), with
captions by people (`manual`) and by a language model (`gpt`); `data_split_info1/{train,val,test}_ids.txt`
list these names. The character is 0.95 m tall: `metres` makes an adult of it.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import whole
from motionloom.datasets.base.register import register
from motionloom.datasets.convert.common.arrays import check_array_header, load_array
from motionloom.datasets.convert.common.facts import Fact
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.release import Entry, Figure, Release, ReleaseClip, ReleaseConfig
from motionloom.datasets.convert.common.tables import captions_of, read_json, require_record
from motionloom.datasets.convert.sets.vectors import walked

FPS = 30.0
JOINTS = 24
WIDTH = 4 + 12 * JOINTS + 4
FEATURES = "renamed_feats"
CAPTIONS = "all_caption_clean.json"
_POSITIONS = slice(4 + 6 * JOINTS, 4 + 9 * JOINTS)

ORDER = (15, 16, 20, 1, 17, 21, 2, 18, 22, 3, 19, 23, 4, 7, 11, 6, 8, 12, 9, 13, 10, 14)
"""The file's joints that stand for the 22 of `smpl22`; the neck's second and a copy of the root do not."""


class SnapMoGenConfig(ReleaseConfig):
    """Options of the SnapMoGen converter; `source` is the folder that holds renamed_feats/."""

    name: str = "snapmogen"
    metres: float = 0.018
    """Metres in a unit of the files: 0.01 keeps the character's size, 0.018 makes it as tall as an adult."""


class SnapMoGen(Release[SnapMoGenConfig]):
    """The SnapMoGen converter."""

    name = "snapmogen"
    title = "SnapMoGen"
    summary = "SnapMoGen: motions with long descriptions (vectors of 296 columns) to shards."
    example = "SnapMoGen shards"
    config_class = SnapMoGenConfig
    terms = "SnapMoGen-noncommercial"
    lists = ("data_split_info", "data_split_info1", "data_split_info2")
    published = "paper, NeurIPS 2025: 20,450 clips, 43.7 hours"

    def entries(self, draft: ConversionPlan[ReleaseClip]) -> Iterable[Entry]:
        source = self.config.source
        if not (source / FEATURES).is_dir():
            raise UserError(f"{source}: no {FEATURES}/ in it; give the folder of the release")
        records = require_record(read_json(source / CAPTIONS, CAPTIONS), CAPTIONS)
        draft.known.beside.add(CAPTIONS)
        for key in dict.fromkeys([*records, *(self.listed or {})]):
            entries = list[Entry]()
            with draft.reading(f"{CAPTIONS}: '{key}'"):
                entries.append(self._entry(key, records.get(key, {})))
            yield from entries

    @staticmethod
    def _entry(key: str, stated: object) -> Entry:
        where = f"{CAPTIONS}: '{key}'"
        record = require_record(stated, where)
        recording, *bounds = key.split("#")
        if len(bounds) != 2:
            raise UserError(f"{where}: a clip is named NAME#FIRST#LAST, with frames for FIRST and LAST")
        first, last = (whole(bound, f"{where}: FIRST and LAST of NAME#FIRST#LAST") for bound in bounds)
        texts = [text for kind in ("manual", "gpt") for text in captions_of(record.get(kind), kind)]
        facts: dict[str, Fact] = {"recording": recording}
        file = f"{FEATURES}/{recording}.npy"
        return Entry(key, file, tuple(texts), None, recording, facts, first=first, last=last)

    def length(self, path: Path, label: str) -> tuple[int, float]:
        return check_array_header(path, width=WIDTH, name=label), FPS

    def figure(self, clip: ReleaseClip) -> Figure:
        label = clip.entry.file
        values = load_array(self.path_of(label), width=WIDTH, name=label, limit=1e4)
        return Figure(joints=joints_of_296(values)[:, ORDER] * self.config.metres)


def joints_of_296(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Columns [T, 296] -> the character's 24 joints [T, 24, 3] in the files' unit.

    A step is turned back by the heading of its own frame, as the published encoder made it (its decoder takes
    the next frame's).
    """
    columns: NDArray[np.float64] = np.asarray(values, dtype=np.float64)
    heading = np.concatenate([[0.0], np.cumsum(columns[:-1, 0])])
    positions = columns[:, _POSITIONS].reshape(len(columns), JOINTS, 3)
    return walked(positions, heading, columns[:-1, 1:3])


register(SnapMoGen)
