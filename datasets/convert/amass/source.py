"""AMASS conversion: options, and the motion files of a source folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from pydantic import Field, model_validator

from motionloom.datasets.convert.common.caption_options import CaptionConfig
from motionloom.datasets.convert.common.files import inside, read_in_threads
from motionloom.datasets.convert.common.plan import drop
from motionloom.datasets.convert.common.smpl_npz import MotionHeader, read_motion_header
from motionloom.datasets.convert.common.splits import check_id
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Dropped, UserError

SUFFIX = ".npz"
LICENCE = "AMASS-noncommercial"
"""Stated for every subset. The motions come from many laboratories with terms of their own, some of them
freer, but the fits are AMASS's: non-commercial research only, and not to be passed on.
"""


class AmassConfig(CaptionConfig):
    """AMASS, or any folder tree of SMPL, SMPL-H or SMPL-X clips in .npz files (`SUBSET/subject/clip.npz`)."""

    name: str = "amass"
    """Name of the data set; part of the shards' file names."""
    layout: str = "body133"
    """`body133` or `h3d263`; `wholebody313` has the fingers too."""
    fps: float = Field(default=20.0, gt=0, le=240)
    """Frame rate of the shards; clips are resampled by time."""
    body_model: Path | None = None
    """Your SMPL-H, SMPL-X or SMPL model (.npz) for clips of any gender. Without one, poses keep their
    rotations and take the bone lengths of one neutral adult.
    """
    body_model_female: Path | None = None
    """The same, for female clips."""
    body_model_male: Path | None = None
    """The same, for male clips."""
    humanml_index: Path | None = None
    """HumanML3D's `index.csv`: convert its clips (cut, and named by its numbers) instead of whole files."""
    humanml_texts: Path | None = None
    """HumanML3D's folder of texts, for the clips of `humanml_index`."""
    mirror: bool = False
    """With `humanml_index`: also the mirrored clips (`M...`), which have texts of their own there."""
    up: Literal["z", "y"] = "z"
    """The axis that points up in the files; AMASS's is z."""
    source_fps: float | None = Field(default=None, gt=0)
    """Overrides the files' frame rate, for collections that state a wrong one or none."""
    retarget: bool = False
    """Give every clip the bone lengths of the layout's skeleton (h3d features always do)."""

    @model_validator(mode="after")
    def _consistent(self) -> AmassConfig:
        if self.humanml_index is None and (self.mirror or self.humanml_texts is not None):
            raise ValueError("mirror and humanml_texts need humanml_index")
        if self.humanml_index is not None and self.captions is not None:
            raise ValueError("captions and humanml_index exclude each other; the index has humanml_texts")
        return self

    def motion_layout(self) -> MotionLayout:
        """The layout of the written shards."""
        layout = super().motion_layout()
        if layout.family == "raw" or layout.has("face"):
            raise UserError(
                f"layout {self.layout} cannot be made from AMASS; use body133, wholebody313 or h3d263"
            )
        return layout


@dataclass(frozen=True)
class AmassFile:
    """A motion file as the scan finds it."""

    path: Path
    label: str
    """Path in the source."""
    size: int

    @property
    def id(self) -> str:
        """Id of the whole file as one clip."""
        return self.label.removesuffix(SUFFIX)

    @property
    def subset(self) -> str:
        """Folder of the release: the third name from the end."""
        parts = PurePosixPath(self.label).parts
        return parts[-3] if len(parts) > 2 else "."


def list_files(source: Path) -> tuple[list[AmassFile], int, list[Dropped]]:
    """Motion files in name order, the number of other files, and what cannot be opened.

    Files that hold the shape of a subject without motion (`shape.npz`, `..._stagei.npz`) count as others.
    """
    if not source.is_dir():
        raise UserError(f"{source}: no such folder")
    files: list[AmassFile] = []
    broken: list[Dropped] = []
    others = 0
    for folder, folders, names in os.walk(source):
        links = [name for name in folders if (Path(folder) / name).is_symlink()]
        for name in (*names, *links):
            path = Path(folder) / name
            relative = path.relative_to(source).as_posix()
            label = relative.encode("utf-8", "backslashreplace").decode()  # names may be any bytes
            if name in links:
                reason = "a link to a folder, which is not followed; put the folder in its place"
                broken.append(Dropped(source=label, reason=reason))
            elif not name.endswith(SUFFIX) or name == "shape.npz" or name.endswith("_stagei.npz"):
                others += 1
            else:
                try:
                    check_id(relative, label)
                    files.append(AmassFile(path, label, inside(source, relative).stat().st_size))
                except (UserError, OSError) as error:
                    broken.append(drop(label, error))
    if not files:
        raise UserError(f"{source}: no {SUFFIX} file with motion in it")
    return sorted(files, key=lambda file: file.label), others, sorted(broken, key=lambda drop: drop.source)


def read_headers(
    files: Sequence[AmassFile], workers: int, progress: bool
) -> tuple[list[tuple[AmassFile, MotionHeader]], list[Dropped]]:
    """The files that can be read, with what they state, and the others."""
    out: list[tuple[AmassFile, MotionHeader]] = []
    broken: list[Dropped] = []
    headers = read_in_threads(_read, files, workers=workers, progress=progress)
    for file, header in zip(files, headers, strict=True):
        if isinstance(header, UserError):
            broken.append(drop(file.label, header))
        else:
            out.append((file, header))
    return out, broken


def _read(file: AmassFile) -> MotionHeader | UserError:
    try:
        return read_motion_header(file.path, file.label)
    except UserError as error:
        return error
