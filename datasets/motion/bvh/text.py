"""The text of a BVH file: hierarchy line by line, motion block as one array.

Every function names the file and the line in its `UserError`. `bvh.py` gives the numbers their meaning.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, field
from decimal import ROUND_DOWN, ROUND_HALF_UP, Decimal, InvalidOperation
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import read_plain

Floats = NDArray[np.float64]

CHANNELS = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
MOST_JOINTS, MOST_NAME = 1000, 200
"""Joints of one figure, and characters of a joint's name. The richest rigs have hundreds of joints."""
MAX_FILE_BYTES = 2**30
"""A motion file beyond this is refused unread: a few hours of text, or a bomb."""
LARGEST = 1e7
"""No length in millimetres and no angle in degrees is larger."""
MISCOUNTED = 1
"""Rows by which the header may be off: a recorder that was stopped counts the row that it did not write."""
_CANONICAL = {name.lower(): name for name in CHANNELS}
_MOTION = re.compile(rb"^[ \t]*MOTION[ \t]*$", re.IGNORECASE | re.MULTILINE)
_HEADER = re.compile(
    rb"\s*Frames[ \t]*:[ \t]*(\S+)[ \t]*\n\s*Frame[ \t]+Time[ \t]*:[ \t]*(\S+)[ \t]*(?:\n|$)", re.IGNORECASE
)
_NUMBER = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


@dataclass(frozen=True)
class MotionSection:
    """Place of the MOTION section in the bytes, and the numbers of its two header lines."""

    start: int
    body: int
    frames: int
    fps: float


@dataclass
class Hierarchy:
    """Joints in file order; parents come before children (-1 = root)."""

    names: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    offsets: list[list[float]] = field(default_factory=list)
    channels: list[tuple[str, ...]] = field(default_factory=list)
    ends: dict[int, list[float]] = field(default_factory=dict)
    """OFFSET of the End Site of the joints that have one; of several the first."""


def load_text(source: Path | str | bytes, name: str | None) -> tuple[bytes, str]:
    """The bytes with LF line ends, without BOM and padding at the end, and what errors call them."""
    if isinstance(source, bytes):
        data = source
        where = name or "BVH data"
    elif isinstance(source, str) and "\n" in source:
        data = source.encode()
        where = name or "BVH text"
    else:
        where = name or str(source)
        try:
            data = read_plain(Path(source), MAX_FILE_BYTES, where)
        except OSError as error:
            raise UserError(f"{where}: cannot read ({error.strerror})") from None
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise UserError(f"{where}: UTF-16 text; save it as UTF-8")
    # DOS ends texts with 0x1A, and what fills blocks of a disk writes NUL behind them.
    return data.removeprefix(b"\xef\xbb\xbf").rstrip(b"\0\x1a \n"), where


def find_motion(data: bytes, where: str) -> MotionSection:
    """Locate the MOTION section and read its frame count and frame time."""
    if not data.strip():
        raise UserError(f"{where}: empty file")
    marker = _MOTION.search(data)
    if marker is None:
        raise UserError(f"{where}: no MOTION section; the file has no frames")
    header = _HEADER.match(data, marker.end())
    if header is None:
        line = data.count(b"\n", 0, marker.end()) + 2
        raise UserError(
            f"{where}: line {line}: expected 'Frames: <count>' and 'Frame Time: <seconds>' after MOTION"
        )
    frames = header.group(1)
    fps = _frame_rate(header.group(2), where)
    if not frames.isdigit() or len(frames) > 12:
        raise UserError(f"{where}: 'Frames: {shown(frames)}' is not a whole number")
    if int(frames) == 0:
        raise UserError(f"{where}: 'Frames: 0': the file has no frames")
    return MotionSection(marker.start(), header.end(), int(frames), fps)


def _frame_rate(text: bytes, where: str) -> float:
    """Frames a second of a frame time. 0.0333 and 0.033333 both mean 30 fps; 0.033367 is 29.97."""
    try:
        exact = Decimal(text.decode("ascii", "replace"))
    except InvalidOperation:
        raise UserError(f"{where}: 'Frame Time: {shown(text)}' is not a number") from None
    if not exact.is_finite() or not Decimal("1e-5") < exact < 60:
        raise UserError(
            f"{where}: 'Frame Time: {shown(text)}' must be seconds a frame, above 0.00001 and below 60; "
            "the frame rate would be meaningless"
        )
    fps = 1 / float(exact)
    # A written frame time is cut or rounded; it means a whole rate where that rate, written so, is the same.
    whole = round(fps)
    if whole:
        digit = Decimal(1).scaleb(max(int(exact.as_tuple().exponent), -12))
        near = {(Decimal(1) / whole).quantize(digit, mode) for mode in (ROUND_DOWN, ROUND_HALF_UP)}
        fps = float(whole) if exact.quantize(digit) in near else fps
    return fps


def read_values(data: bytes, start: int, frames: int, width: int, where: str) -> Floats:
    """The motion block [T, width] from byte `start` on; every row must hold `width` finite numbers.

    T is the number of rows, from which the header's `frames` may be `MISCOUNTED` away.
    """
    body = data[start:].rstrip()
    if not body:
        raise UserError(f"{where}: the header says {frames} frames, 0 found")
    # Numbers are counted by line before they are parsed, so that a short row is named and nothing shifts.
    text = np.frombuffer(body, dtype=np.uint8)
    visible = text > 32
    starts = np.flatnonzero(visible & np.r_[True, ~visible[:-1]])
    # A line's numbers are those that start before the next line does.
    counts = np.diff(
        np.searchsorted(starts, np.flatnonzero(text == ord("\n"))), prepend=0, append=len(starts)
    )
    lines = data.count(b"\n", 0, start) + 1 + np.flatnonzero(counts)
    counts = counts[counts > 0]
    wrong = np.flatnonzero(counts != width)
    if len(wrong):
        _require_one_motion(data, start, where)
        row = int(wrong[0])
        raise UserError(
            f"{where}: line {lines[row]}: frame {row} (from 0) has {counts[row]} numbers, "
            f"the hierarchy declares {width} channels"
        )
    require_frames(len(counts), frames, where)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # numpy only warns when it stops at a bad word
        try:
            values = np.fromstring(body, dtype=np.float64, sep=" ")
        except (ValueError, DeprecationWarning):
            values = np.empty(0)
    if len(values) == len(counts) * width and (np.abs(values) <= LARGEST).all():  # false for NaN
        return values.reshape(-1, width)
    for at, word in enumerate(body.split()):
        if not is_number(word):
            row, column = divmod(at, width)
            raise UserError(
                f"{where}: line {lines[row]}: frame {row}, channel {column} (from 0): "
                f"'{shown(word)}' is not a finite number up to {LARGEST:g}"
            )
    raise UserError(f"{where}: the motion block holds characters that are not numbers")


def is_number(word: bytes) -> bool:
    """Whether a word of a file is a finite number up to `LARGEST`."""
    return _NUMBER.fullmatch(word) is not None and abs(float(word)) <= LARGEST


def shown(text: bytes) -> str:
    """The beginning of a word, for messages."""
    return text[:40].decode("utf-8", "backslashreplace")


def parse_hierarchy(text: bytes, where: str) -> Hierarchy:
    """Parse everything before MOTION. The files of a collection mostly share one hierarchy, so it is kept."""
    try:
        return _parse_hierarchy(text)
    except UserError as error:
        raise UserError(f"{where}: {error}") from None


@lru_cache(maxsize=8)
def _parse_hierarchy(text: bytes) -> Hierarchy:
    return _HierarchyParser().parse(text)


def require_frames(found: int, stated: int, where: str) -> None:
    """`UserError` when there are not as many rows of values as the header says, give or take `MISCOUNTED`."""
    if abs(found - stated) > MISCOUNTED or not found:
        raise UserError(f"{where}: the header says {stated} frames, {found} found")


def _require_one_motion(data: bytes, start: int, where: str) -> None:
    """`UserError` when a motion block that is wrong holds another one."""
    if second := _MOTION.search(data, start):
        line = data.count(b"\n", 0, second.start()) + 1
        raise UserError(f"{where}: line {line}: a second MOTION section; split the file, one motion each")


def count_frames(data: bytes, section: MotionSection, where: str) -> int:
    """Lines of values; `UserError` when they are not those of the header. The values are not read."""
    body = data[section.body :].strip()
    lines = body.count(b"\n") + bool(body)
    if lines != section.frames:  # blank lines count for nothing
        lines = sum(bool(line.strip()) for line in body.split(b"\n"))
    if abs(lines - section.frames) > MISCOUNTED:
        _require_one_motion(data, section.body, where)
    require_frames(lines, section.frames, where)
    return lines


class _HierarchyParser:
    def __init__(self) -> None:
        self.line = 0
        self.out = Hierarchy()
        self.offsets: dict[int, list[float]] = {}
        self.channels: dict[int, tuple[str, ...]] = {}
        self.open: list[int] = []
        """Open blocks: a joint index, or -1 for an End Site."""
        self.pending: int | None = None
        """The block whose '{' must come next."""

    def parse(self, text: bytes) -> Hierarchy:
        started = False
        for self.line, raw in enumerate(text.split(b"\n"), start=1):
            try:
                line = raw.decode("utf-8")
            except UnicodeDecodeError as error:
                raise self._error(
                    f"'{shown(raw.strip())}' is not UTF-8 text (byte {error.start + 1} of the line); "
                    "rename the joint or save the file as UTF-8"
                ) from None
            for piece in re.findall(r"[{}]|[^{}]+", line):
                words = piece.split()
                if not words:
                    continue
                if started:
                    self._take(words[0].upper(), words, piece.strip())
                elif words[0].upper() == "HIERARCHY":
                    started = True
                else:
                    raise self._error("a BVH file must start with HIERARCHY")
        # Blocks that are still open lack a brace each; so does one that was announced and never opened.
        missing = len(self.open) + (self.pending is not None)
        if missing:
            raise self._error(f"braces are not balanced: {missing} '}}' missing before MOTION")
        if not self.out.names:
            raise self._error("no ROOT joint")
        for joint, name in enumerate(self.out.names):
            if joint not in self.offsets or joint not in self.channels:
                lacks = "CHANNELS" if joint in self.offsets else "OFFSET"
                raise UserError(f"joint '{name}' has no {lacks} line")
        self.out.offsets = [self.offsets[j] for j in range(len(self.out.names))]
        self.out.channels = [self.channels[j] for j in range(len(self.out.names))]
        return self.out

    def _take(self, key: str, words: list[str], piece: str) -> None:
        """One brace or one statement."""
        block = self.open[-1] if self.open else None
        in_joint = block is not None and block >= 0
        # Every statement opens a block that must follow at once, closes one, or belongs to the open one.
        if self.pending is not None:
            if key != "{":
                raise self._error(f"expected '{{' before '{piece[:60]}'")
            self.open.append(self.pending)
            self.pending = None
        elif key == "}" and self.open:
            self.open.pop()
        elif key == "ROOT" and block is None and len(words) > 1:
            if self.out.names:
                raise self._error("a second ROOT; split the file, one character each")
            self.pending = self._add(piece, -1)
        elif key == "JOINT" and block is not None and in_joint and len(words) > 1:
            self.pending = self._add(piece, block)
        elif key == "END" and block is not None and in_joint:
            self.pending = -1
        elif key == "OFFSET" and block is not None:
            offset = self._offset(words)
            if in_joint:
                self.offsets[block] = offset
            else:  # an End Site's: of its joint, which is the block around it
                self.out.ends.setdefault(self.open[-2], offset)
        elif key == "CHANNELS" and block is not None and in_joint:
            self.channels[block] = self._channel_names(words)
        else:
            raise self._error(f"'{piece[:60]}' is not expected here")

    def _error(self, reason: str) -> UserError:
        return UserError(f"line {self.line}: {reason}")

    def _add(self, piece: str, parent: int) -> int:
        name = piece.split(None, 1)[1].strip()  # a name may hold spaces
        if len(name) > MOST_NAME or len(self.out.names) >= MOST_JOINTS:
            long = f"a name of {len(name)} characters; at most {MOST_NAME} are read"
            raise self._error(long if len(name) > MOST_NAME else f"more than {MOST_JOINTS} joints")
        self.out.names.append(name)
        self.out.parents.append(parent)
        return len(self.out.names) - 1

    def _offset(self, words: list[str]) -> list[float]:
        values = [float(word) for word in words[1:] if is_number(word.encode())]
        if len(values) != 3 or len(words) != 4:
            raise self._error(f"'{' '.join(words)[:60]}' must be OFFSET and three finite numbers")
        return values

    def _channel_names(self, words: list[str]) -> tuple[str, ...]:
        joint = self.out.names[self.open[-1]]
        names = [_CANONICAL.get(word.lower(), "") for word in words[2:]]
        if len(words) < 2 or words[1] not in {str(n) for n in range(7)}:
            raise self._error(f"joint '{joint}': CHANNELS must be followed by a count from 0 to 6")
        if int(words[1]) != len(names):
            raise self._error(
                f"joint '{joint}' declares CHANNELS {words[1]} but lists {len(names)} channel names"
            )
        if "" in names:
            raise self._error(
                f"unknown channel '{words[2 + names.index('')][:40]}'; known: {', '.join(CHANNELS)}"
            )
        if len(set(names)) != len(names):
            raise self._error(f"joint '{joint}' lists a channel twice")
        return tuple(names)
