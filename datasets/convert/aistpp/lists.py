"""The lists of AIST++: cross-modal splits and bad sequences, with the defects of the copies in circulation.

Blank lines, spaces at line ends, missing last newlines, and `.json` or `.pkl` after the names are fine.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from motionloom.datasets.convert.common.files import read_text_file
from motionloom.datasets.convert.common.splits import check_id
from motionloom.datasets.schema import Split, UserError
from motionloom.datasets.shards.index import SPLITS

_SUFFIXES = (".json", ".pkl")


@dataclass(frozen=True)
class SequenceLists:
    """What the lists say."""

    splits: dict[str, Split] = field(default_factory=dict)
    ignored: frozenset[str] = frozenset()
    files: tuple[Path, ...] = ()
    """The files read."""
    notes: tuple[str, ...] = ()


def read_lists(
    splits: Path, ignore_list: Path, *, splits_required: bool, ignore_required: bool
) -> SequenceLists:
    """Read `crossmodal_{train,val,test}.txt` (else `{train,val,test}.txt`) of a folder, and an ignore list.

    A sequence in two splits is a `UserError` that names both files. Absent lists are noted, or an error where
    they are required.
    """
    found: dict[str, Split] = {}
    origin: dict[str, str] = {}
    files: list[Path] = []
    notes: list[str] = []
    absent: list[str] = []
    for split in SPLITS:
        paths = [splits / f"crossmodal_{split}.txt", splits / f"{split}.txt"]
        path = next((path for path in paths if path.is_file()), None)
        if path is None:
            absent.append(paths[0].name)
            continue
        files.append(path)
        sequences, found_notes = read_sequences(path)
        notes += found_notes
        for sequence in sequences:
            if sequence in found:
                raise UserError(
                    f"{path}: '{sequence}' is also in {origin[sequence]}; a sequence in two splits leaks"
                )
            found[sequence], origin[sequence] = split, path.name
    if splits_required and not files:
        raise UserError(f"{splits}: no crossmodal_train.txt, crossmodal_val.txt or crossmodal_test.txt")
    if not files:
        notes.append("no split files: split 80/5/15 by a hash of the music")
    elif absent:
        notes.append(f"no {', '.join(absent)} beside the other split files")
    ignored: list[str] = []
    if ignore_list.is_file():
        files.append(ignore_list)
        ignored, found_notes = read_sequences(ignore_list)
        notes += found_notes
    elif ignore_required:
        raise UserError(f"{ignore_list}: no such file")
    else:
        notes.append("no ignore_list.txt: bad sequences of the release are not left out")
    both = sorted(found.keys() & set(ignored))
    if both:
        notes.append(
            f"{len(both)} sequences of the split files are on the ignore list: {', '.join(both[:3])}"
        )
    return SequenceLists(found, frozenset(ignored), tuple(files), tuple(notes))


def read_sequences(path: Path) -> tuple[list[str], list[str]]:
    """The names of a list in order, each once, and notes on repeated lines; `UserError` for a name that is
    none.
    """
    lines: dict[str, int] = {}
    notes: list[str] = []
    for number, line in enumerate(read_text_file(path).split("\n"), start=1):
        name = line.strip()
        for suffix in _SUFFIXES:
            name = name.removesuffix(suffix)
        if not name:
            continue
        check_id(name, f"{path}:{number}")
        if name in lines:
            notes.append(f"{path.name}:{number}: '{name}' is listed twice; line {lines[name]} counts")
        lines.setdefault(name, number)
    return list(lines), notes
