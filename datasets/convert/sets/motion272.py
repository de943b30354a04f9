"""The 272 columns of MotionStreamer and MotionMillion, at 30 fps: joints without inverse kinematics.

| columns | content |
|---|---|
| 0:2 | step of the root since the frame before, x and z, seen from that frame's heading |
| 2:8 | turn of the heading since the frame before, the first two rows of its matrix |
| 8:74 | 22 joints above the origin, seen from this frame's heading, metres, Y up |
| 74:140, 140:272 | their steps; the local rotations of SMPL in six columns |

Joints are read from the positions, so bones are each person's own; the rotations are not needed. Known trees:
`motion_data/` with `texts/` and `split/` (HumanML3D-272, BABEL-272), `motion_data/vector_272/` with
`split/version1/t2m_60_300/` (MotionMillion), `train_stream/` with `train_stream_text/` (BABEL-272-stream).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import is_file
from motionloom.datasets.base.json_doors import whole
from motionloom.datasets.base.records import SPLITS, Caption, Split
from motionloom.datasets.base.register import register
from motionloom.datasets.convert.captions.humanml_text import read_humanml_captions
from motionloom.datasets.convert.common.arrays import check_array_header, load_array
from motionloom.datasets.convert.common.facts import Fact
from motionloom.datasets.convert.common.files import files_in, read_text_file, walk_files
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.release import Entry, Figure, Release, ReleaseClip, ReleaseConfig
from motionloom.datasets.convert.common.splits import original_of
from motionloom.datasets.convert.common.tables import captions_of
from motionloom.datasets.convert.sets.vectors import walked
from motionloom.datasets.motion.layout import BODY_JOINTS

FPS = 30.0
WIDTH = 272
_STEP, _TURN, _POSITIONS = slice(0, 2), slice(2, 8), slice(8, 8 + 3 * BODY_JOINTS)
_MOTION = ("motion_data/vector_272", "motion_data")
_STREAMED = re.compile(r"(?P<first>[^*]+)\*(?P<second>.+)#(?P<frames>\d+)\s*")


class Motion272Config(ReleaseConfig):
    """Options of the converter of 272-column sets; `source` is the folder that holds motion_data/."""

    name: str = "motion272"
    source_fps: float = Field(default=FPS, gt=0, le=240)
    """Frame rate of the files; a copy that was made at another than 30 does not say so."""


class Motion272(Release[Motion272Config]):
    """The converter of 272-column sets."""

    name = "motion272"
    title = "272-column sets"
    summary = "MotionMillion, HumanML3D-272, BABEL-272: vectors of 272 columns to shards."
    example = "MotionMillion shards"
    config_class = Motion272Config
    terms = "272-column set: non-commercial, AMASS's terms where its motions are from there"
    lists = ("split/version1/t2m_60_300", "split", "splits")
    published = "MotionMillion paper: 2,000,000 clips, 2000 hours"

    def stated(self) -> str:
        """MotionMillion's numbers, for its layout alone."""
        return self.published if (self.config.source / _MOTION[0]).is_dir() else ""

    def entries(self, draft: ConversionPlan[ReleaseClip]) -> Iterable[Entry]:
        source = self.config.source
        streams = [split for split in SPLITS if (source / f"{split}_stream").is_dir()]
        if streams:
            for split in streams:
                names = [name.removesuffix(".npy") for name in files_in(source / f"{split}_stream", ".npy")]
                yield from (
                    self._entry(f"{split}_stream", f"{split}_stream_text", n, split, draft) for n in names
                )
            return
        motion = next((name for name in _MOTION if (source / name).is_dir()), None)
        if motion is None:
            raise UserError(f"{source}: no {_MOTION[-1]}/ in it; unpack motion_data.zip, or give its folder")
        here = (name.removesuffix(".npy") for name in walk_files(source / motion) if name.endswith(".npy"))
        for name in sorted(here):
            yield self._entry(motion, "texts", name, None, draft)

    def _entry(
        self, motion: str, texts: str, name: str, split: Split | None, draft: ConversionPlan[ReleaseClip]
    ) -> Entry:
        original = original_of(name)
        captions = tuple(self._texts(f"{texts}/{name}.txt", draft))
        facts: dict[str, Fact] = {
            "subset": name.split("/")[0] if "/" in name else "",
            "mirrored": float(original is not None),
        }
        stem = f"{motion}/{name}" if motion.endswith("_stream") else name
        return Entry(
            stem, f"{motion}/{name}.npy", captions, split, original or name, facts,
            mirror_of=original,
        )  # fmt: skip

    def _texts(self, file: str, draft: ConversionPlan[ReleaseClip]) -> Iterator[Caption]:
        """Captions in HumanML3D's grammar, two in a row of BABEL's stream, or plain lines."""
        path = self.config.source / file
        if not is_file(path):
            return
        with draft.reading(file):
            lines = [line for line in read_text_file(path, file).split("\n") if line.strip()]
            if any(line.count("#") >= 3 for line in lines):
                captions, wrong = read_humanml_captions(path, seconds=None, name=file)
                draft.notes += [f"{file}: {problem}" for problem in wrong]
                yield from captions
                return
            for line in lines:
                if file.split("/")[0].endswith("_stream_text") and (row := _STREAMED.fullmatch(line)):
                    change = whole(row["frames"], file) / self.config.source_fps
                    yield from captions_of(row["first"], "babel", 0.0, change)
                    yield from captions_of(row["second"], "babel", change)
                else:
                    yield from captions_of(line, "texts")

    def length(self, path: Path, label: str) -> tuple[int, float]:
        return check_array_header(path, width=WIDTH, name=label), self.config.source_fps

    def figure(self, clip: ReleaseClip) -> Figure:
        label = clip.entry.file
        values = load_array(self.path_of(label), width=WIDTH, name=label, limit=1e3)
        return Figure(joints=joints_of_272(values))


def joints_of_272(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Columns [T, 272] -> joints [T, 22, 3] in metres, the first root above the origin."""
    columns: NDArray[np.float64] = np.asarray(values, dtype=np.float64)
    turns = columns[:, _TURN]
    heading = np.cumsum(np.arctan2(turns[:, 2], turns[:, 0]))  # first row of a turn about Y: cos, 0, sin
    positions = columns[:, _POSITIONS].reshape(len(columns), BODY_JOINTS, 3)
    return walked(positions, heading, columns[1:, _STEP])


register(Motion272)
