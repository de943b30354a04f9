"""Check single source files, with the very readers that the converters use: `ok`, or the reason why not.

| suffix | read as |
|---|---|
| `.tar` | a WebDataset shard, of other tools too: `motion.npy` and `json` or `meta.json` for each key |
| `.npy` | a motion array of the layout asked for (Motion-X's `smplx322` unless given), or joints |
| `.npz` | SMPL parameters as AMASS publishes them |
| `.pkl` | an AIST++ annotation, through the restricted unpickler |
| `.bvh`, `.amc` | BVH; AMC with its ASF beside it |
| `.wav`, `.flac`, `.ogg`, `.mp3` | sound |
| `.txt` | ids, by the name of file or folder; captions in HumanML3D's grammar or, without any `#`, plain |

Nothing is written, run or extracted, whatever a file holds.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.sound import read_sound
from motionloom.datasets.check.clip import odd_value, require_sensible
from motionloom.datasets.convert.aistpp.pickle_reader import read_aist_motion
from motionloom.datasets.convert.amass.smpl_npz import read_motion, read_motion_header
from motionloom.datasets.convert.bvh.read import read_motion as read_mocap
from motionloom.datasets.convert.captions.humanml_text import read_humanml_captions
from motionloom.datasets.convert.common.arrays import load_array, read_array_header
from motionloom.datasets.convert.common.features import require_human
from motionloom.datasets.convert.common.files import read_text_file
from motionloom.datasets.convert.common.scan import read_file
from motionloom.datasets.convert.common.splits import read_ids, read_split_files
from motionloom.datasets.motion.layout import LAYOUTS, MotionLayout
from motionloom.datasets.schema import SPLITS, Config, UserError, parse_json
from motionloom.datasets.shards.tar import npy_from_bytes, scan_tar
from motionloom.datasets.text.clean import usable_caption

JOINTS = {"joints22": (22, 3), "joints52": (52, 3)}
"""Further names for `layout`: joint positions [T, N, 3] in metres."""

_SPLIT_NAMES = frozenset((*SPLITS, "train_val", "all"))
_SPLIT_FOLDERS = frozenset(("splits", "split"))


class FileRules(Config):
    """Expectations of single files."""

    layout: str | None = None
    """Layout of arrays. None: `.npy` files are Motion-X's `smplx322`, shards may hold any width."""
    fps: float | None = None
    """Frame rate, for the ranges of speeds; None = the layout's usual one."""
    seconds: float | None = None
    """Length of the clips that captions belong to; None leaves their ends unchecked."""

    def model_post_init(self, _: object) -> None:
        if self.layout not in (None, *JOINTS, *LAYOUTS):
            raise UserError(f"no motion layout '{self.layout}'; known: {', '.join((*LAYOUTS, *JOINTS))}")

    def motion_layout(self) -> MotionLayout:
        """The layout of arrays (not for joints)."""
        return MotionLayout.named(self.layout or "smplx322", fps=self.fps)


@dataclass(frozen=True)
class Verdict:
    """The outcome for one file. `problems` is empty when it may be used; `notes` are worth knowing."""

    path: Path
    what: str = ""
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        return not self.problems

    def __str__(self) -> str:
        return f"{self.path}: {'; '.join(self.problems) if self.problems else f'ok, {self.what}'}"


def check_file(path: Path, rules: FileRules | None = None) -> Verdict:
    """Read one file as its suffix says. Raises `UserError` only for suffixes that nothing here reads."""
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise UserError(f"{path}: nothing here reads '{path.suffix}' files; known: {', '.join(_READERS)}")
    if not path.is_file():  # a pipe would be waited for
        return Verdict(path, problems=["no such file" if not path.exists() else "not a plain file"])
    try:
        return reader(path, rules or FileRules())
    except (UserError, ValueError) as error:
        told = str(error).removeprefix(f"{path}: ").replace(f"{path}:", "line ", 1)
        return Verdict(path, problems=[told])
    except OSError as error:
        return Verdict(path, problems=[f"cannot be read ({error.strerror or error})"])


def check_folder(folder: Path, rules: FileRules | None = None) -> Iterator[Verdict]:
    """Every file below a folder that can be read, in order of its path; links to folders are not followed.

    A folder that holds at least two of `train.txt`, `val.txt`, `test.txt` is also checked for ids in two
    splits.
    """
    for here, folders, names in os.walk(folder):
        folders.sort()
        splits = [split for split in SPLITS if f"{split}.txt" in names]
        if len(splits) > 1:
            yield _check_splits(Path(here), splits)
        for name in sorted(names):
            if Path(name).suffix.lower() in _READERS:
                yield check_file(Path(here) / name, rules)


def _check_splits(folder: Path, splits: Sequence[str]) -> Verdict:
    try:
        ids, notes = read_split_files(folder)
    except UserError as error:
        return Verdict(folder, problems=[str(error)])
    return Verdict(folder, f"splits {', '.join(splits)}: {len(ids)} ids, none in two", notes=notes)


def _check_tar(path: Path, rules: FileRules) -> Verdict:
    clips = scan_tar(path, foreign=True)
    problems: list[str] = []
    with path.open("rb") as file:
        for clip in clips:
            for name, (start, size) in clip.members.items():
                file.seek(start)
                if problem := _member_problem(f"'{clip.key}.{name}'", name, file.read(size), rules):
                    problems.append(problem)
    return Verdict(path, f"shard of {len(clips)} samples", problems)


def _member_problem(where: str, name: str, raw: bytes, rules: FileRules) -> str:
    """Return the fault of a member of a stranger's shard; empty where there is none."""
    try:
        if name.endswith("json"):
            parse_json(raw, where)
        elif name.endswith("npy"):
            values = npy_from_bytes(raw, where)
            if name == "motion.npy":
                _check_motion(values, rules.motion_layout() if rules.layout in LAYOUTS else None)
            else:
                require_sensible(name, values)
    except UserError as error:
        return str(error)
    except ValueError as error:
        return f"{where}: unfit ({error})"
    return ""


def _check_motion(values: NDArray[np.floating], layout: MotionLayout | None) -> None:
    if values.ndim != 2 or not len(values):
        raise ValueError(f"{values.dtype} {list(values.shape)}, wanted floats [T >= 1, D]")
    require_sensible("motion.npy", values)
    if layout is None:
        return
    if values.shape[1] != layout.dim:
        raise ValueError(f"{values.shape[1]} columns, layout {layout.name} has {layout.dim}")
    odd_value(values, layout)


def _check_npy(path: Path, rules: FileRules) -> Verdict:
    if rules.layout is not None and rules.layout in JOINTS:
        values = load_array(path, width=JOINTS[rules.layout])
        require_human(values, rules.fps or 20.0)
        return Verdict(path, f"joints {list(values.shape)} {values.dtype}")
    layout = rules.motion_layout()
    try:
        values = load_array(path, width=layout.dim)
    except UserError as error:
        raise UserError(f"{error}{_layout_hint(path, layout)}") from None
    strange = odd_value(values, layout)
    notes = [f"beyond what a person can do: {strange}"] if strange else []
    return Verdict(path, f"{layout.name} {list(values.shape)} {values.dtype}", notes=notes)


def _layout_hint(path: Path, layout: MotionLayout) -> str:
    try:
        with path.open("rb") as file:
            shape = read_array_header(file, str(path)).shape
    except UserError:
        return ""
    if len(shape) == 3 and (shape[1:] in JOINTS.values()):
        return f"; for joints: --set layout=joints{shape[1]}"
    known = [name for name in LAYOUTS if MotionLayout.named(name).dim == shape[-1] != layout.dim]
    return f"; for this width: --set layout={known[0]}" if len(shape) == 2 and known else ""


def _check_npz(path: Path, rules: FileRules) -> Verdict:
    header = read_motion_header(path, str(path))
    read_motion(path, str(path), hands=header.hands)
    rate = "no frame rate" if header.fps is None else f"{header.fps:g} fps"
    return Verdict(path, f"{header.kind} parameters, {header.frames} frames, {rate}")


def _check_pickle(path: Path, rules: FileRules) -> Verdict:
    motion = read_aist_motion(path)
    return Verdict(path, f"AIST++ motion, {len(motion.poses)} frames")


def _check_mocap(path: Path, rules: FileRules) -> Verdict:
    motion = read_mocap(read_file(path, str(path)), str(path))
    kind = path.suffix[1:].upper()
    return Verdict(path, f"{kind}, {len(motion.joints)} joints, {motion.frames} frames, {motion.fps:g} fps")


def _check_sound(path: Path, rules: FileRules) -> Verdict:
    samples, rate = read_sound(path)
    return Verdict(path, f"sound, {len(samples) / rate:.2f} s at {rate} Hz")


def _check_text(path: Path, rules: FileRules) -> Verdict:
    if path.stem.lower() in _SPLIT_NAMES or path.parent.name.lower() in _SPLIT_FOLDERS:
        ids, notes = read_ids(path)
        return Verdict(path, f"{len(ids)} ids", [] if ids else ["no ids"], notes)
    lines = [line for line in read_text_file(path).split("\n") if line.strip()]
    if any("#" in line for line in lines):
        captions, problems = read_humanml_captions(path, seconds=rules.seconds)
        count = len(captions)
    else:
        problems = [
            f"line {number}: no usable caption"
            for number, line in enumerate(lines, 1)
            if not usable_caption(line)
        ]
        count = len(lines) - len(problems)
    if not count:
        problems = [*problems, "no usable text is left"] if problems else ["no usable text"]
    return Verdict(path, f"{count} captions", problems)


_READERS: dict[str, Callable[[Path, FileRules], Verdict]] = {
    ".tar": _check_tar,
    ".npy": _check_npy,
    ".npz": _check_npz,
    ".pkl": _check_pickle,
    **dict.fromkeys((".bvh", ".amc"), _check_mocap),
    **dict.fromkeys((".wav", ".flac", ".ogg", ".mp3"), _check_sound),
    ".txt": _check_text,
}

FILE_SUFFIXES = frozenset(_READERS)
"""Suffixes that `check_file` reads."""
