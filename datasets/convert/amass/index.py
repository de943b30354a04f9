"""HumanML3D's `index.csv`: which stretch of which AMASS file is which captioned clip.

Facts of the published preparation that the numbers depend on:
- frames count after every `int(fps / 20)`-th frame of the file was kept, so at 100 or 120 frames a second
  they are twentieths of a second, and at 250 (thinned to 20.83) they are not;
- the first seconds of five subsets are cut away before counting (`LEADS`);
- subset folders have the names of the first AMASS release; today's names are translated (`OLD_NAMES`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from motionloom.datasets.convert.common.files import check_id
from motionloom.datasets.convert.common.tables import read_csv
from motionloom.datasets.schema import UserError

INDEX_FPS = 20
"""Frames a second that the index means."""

LEADS = {
    "Eyes_Japan_Dataset": 60,
    "MPI_HDM05": 60,
    "TotalCapture": 20,
    "MPI_Limits": 20,
    "Transitions_mocap": 10,
}
"""Thinned frames cut from the start of a file before the index counts."""

OLD_NAMES = {
    "BMLrub": "BioMotionLab_NTroje",
    "DFaust": "DFaust_67",
    "HDM05": "MPI_HDM05",
    "MoSh": "MPI_mosh",
    "PosePrior": "MPI_Limits",
    "SSM": "SSM_synced",
    "TCDHands": "TCD_handMocap",
    "Transitions": "Transitions_mocap",
}
"""Subset folders of later AMASS releases -> those of the index."""

_COLUMNS = ("source_path", "start_frame", "end_frame", "new_name")


@dataclass(frozen=True)
class IndexRow:
    """One clip: thinned frames [start, end) of a file; a negative end counts from the file's."""

    id: str
    source: str
    """Path of the file as the index has it, below `pose_data/`."""
    start: int
    end: int

    @property
    def subset(self) -> str:
        return self.source.split("/", 1)[0]

    def cut(self, frames: int, fps: float) -> tuple[int, int]:
        """First and last + 1 frame of the file (`frames` at `fps`); both 0 when nothing lies there.

        Every frame between is kept, so the clip can be resampled to any rate.
        """
        step = thinning(fps)
        lead = LEADS.get(self.subset, 0)
        thinned = max(math.ceil(frames / step) - lead, 0)
        start, end, _ = slice(self.start, self.end).indices(thinned)
        if end <= start:
            return 0, 0
        return (lead + start) * step, (lead + end - 1) * step + 1


def thinning(fps: float) -> int:
    """Return how many frames of the file make one frame of the index."""
    return max(int(fps / INDEX_FPS), 1)


def clip_key(path: str) -> str:
    """Return the key that a file and its row of the index share over the AMASS releases.

    The last three parts of the path (subset, subject, clip) without the endings `_poses` and `_stageii`;
    later releases write `_` for spaces.
    """
    parts = list(PurePosixPath(path).with_suffix("").parts[-3:])
    parts[0] = OLD_NAMES.get(parts[0], parts[0])
    parts[-1] = parts[-1].removesuffix("_poses").removesuffix("_stageii")
    return "/".join(parts).replace(" ", "_")


def read_index(path: Path) -> list[IndexRow]:
    """All rows; `UserError` names the line of a malformed one or of an id seen before."""
    rows: dict[str, IndexRow] = {}
    for where, line in read_csv(path, _COLUMNS):
        row = _row(line, where)
        if row.id in rows:
            raise UserError(f"{where}: clip '{row.id}' has a row already")
        rows[row.id] = row
    return list(rows.values())


def _row(line: dict[str, str], where: str) -> IndexRow:
    source = line["source_path"].removeprefix("./").removeprefix("pose_data/")
    try:
        start, end = int(line["start_frame"]), int(line["end_frame"])
    except ValueError:
        raise UserError(
            f"{where}: frames '{line['start_frame'][:20]}' to '{line['end_frame'][:20]}' are not numbers"
        ) from None
    if start < 0:
        raise UserError(f"{where}: start_frame {start} is negative")
    name = check_id(line["new_name"].removesuffix(".npy"), where)
    return IndexRow(name, check_id(source, where), start, end)
