"""Work that the processes of a run divide: units, each made once, by any of them, and kept in case of a kill.

A unit's result is a file in the stage's folder until the stage has read all of them, so the processes need
nothing but the run folder they share, and what a killed run has made is not made again. Units are the same
whatever the number of processes, and so is what is made of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from zipfile import BadZipFile
from zlib import error as ZlibError

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import atomic_file
from motionloom.pipeline.store.files import remove_tree

Arrays = dict[str, NDArray[Any]]
"""Result of a unit, by name."""

Row = dict[str, float]
"""Figures of one clip, by name."""

WORK = "work"
"""Folder of the units within a stage's."""


@dataclass(frozen=True)
class Units:
    """The units of one stage, and which of them are this process's."""

    folder: Path
    rank: int = 0
    world: int = 1

    def make(
        self,
        name: str,
        count: int,
        result: Callable[[int], Mapping[str, NDArray[Any]]],
        done: Callable[[int], object] | None = None,
    ) -> None:
        """Make this process's missing units of 0 to `count` - 1; `done` is called with each unit's number."""
        self.folder.mkdir(parents=True, exist_ok=True)
        for index in range(self.rank, count, self.world):
            path = self._path(name, index)
            if not path.is_file():
                with atomic_file(path) as file:
                    np.savez(file, allow_pickle=False, **dict(result(index)))
            if done is not None:
                done(index)

    def read(self, name: str, count: int) -> Iterator[Arrays]:
        """The results, in order; a `UserError` names a file that is damaged."""
        for index in range(count):
            path = self._path(name, index)
            try:
                with np.load(path, allow_pickle=False) as file:
                    found = {key: file[key] for key in file.files}
            except (ValueError, TypeError, EOFError, KeyError, BadZipFile, ZlibError) as error:
                raise UserError(
                    f"{path}: damaged ({' '.join(str(error).split())[:100]}); delete it and run the same "
                    f"command again, which makes it anew"
                ) from None
            yield found

    def mine(self, sizes: Sequence[int]) -> int:
        """Sum of the sizes of this process's units, for a progress bar."""
        return sum(sizes[self.rank :: self.world])

    def clear(self) -> None:
        remove_tree(self.folder)

    def _path(self, name: str, index: int) -> Path:
        return self.folder / f"{name}-{index:06d}.npz"


def even_slices(count: int, most: int) -> list[slice]:
    """Slices of `count` things, `most` in one at most and all nearly equal, so that processes share well."""
    edges = np.linspace(0, count, -(-count // most) + 1).astype(int).tolist()
    return [slice(first, end) for first, end in pairwise(edges)]


def as_table(rows: Sequence[Mapping[str, float]], prefix: str = "") -> Arrays:
    """Rows as one float64 array [n] for each name; NaN where a row lacks it."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {prefix + name: np.array([row.get(name, np.nan) for row in rows]) for name in names}


def as_rows(table: Mapping[str, NDArray[Any]], prefix: str = "") -> list[Row]:
    """`as_table` undone, of the names with `prefix`."""
    columns = {name[len(prefix) :]: values for name, values in table.items() if name.startswith(prefix)}
    count = max((len(values) for values in columns.values()), default=0)
    return [
        {name: float(values[row]) for name, values in columns.items() if not np.isnan(values[row])}
        for row in range(count)
    ]
