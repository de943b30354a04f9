"""Published sets of BVH files: the `bvh` converter, with captions and splits from the set's own tables."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import NamedTuple

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Caption
from motionloom.datasets.convert.bvh.config import BvhConfig
from motionloom.datasets.convert.captions.options import Listing, list_clips
from motionloom.datasets.convert.captions.read import CaptionRow
from motionloom.datasets.convert.common.facts import Facts
from motionloom.datasets.convert.common.splits import hash_split, read_split_files
from motionloom.datasets.motion.bvh.joint_map import Unit, Up


class Row(NamedTuple):
    """A file's row in a set's tables."""

    texts: tuple[Caption, ...]
    group: str
    """Files that a split never tears apart."""
    facts: Facts


class BvhSetConfig(BvhConfig):
    """Options of published sets of BVH files."""

    everyday = ()

    unit: Unit = "cm"
    """Length unit of the files."""
    up: Up = "y"
    """Upward axis of the files."""

    @property
    @abstractmethod
    def rows(self) -> Mapping[str, Row]:
        """Return the rows of the tables by the names of files without folder and suffix; read once."""

    @property
    def has_captions(self) -> bool:
        return True

    def about(self, path: str) -> Facts:
        row = self.rows.get(stem(path))
        return row.facts if row else {}

    def unfit(self, path: str) -> str:
        missing = self.bad_rows.get(stem(path), "not in the tables of the set")
        return "" if stem(path) in self.rows else missing

    def listing(self, paths: Sequence[str]) -> Listing:
        if self.captions:
            return super().listing(paths)
        if not self.rows and self.bad_rows:
            raise UserError(next(iter(self.bad_rows.values())))
        known = self.rows
        here = {stem(path): path for path in paths}
        rows = [
            CaptionRow(name, row.texts, here[name], hash_split(row.group), name)
            for name, row in known.items()
            if name in here
        ]
        found = list_clips(paths, rows, read_split_files(self.splits) if self.splits else None, [])
        found.missing.update({name: name for name in known if name not in here})
        return found


def stem(path: str) -> str:
    """The name of a file without folder and suffix."""
    return PurePosixPath(path).stem
