"""Takes of a face: tables of ARKit's 52 weights as Live Link Face and other recorders write them.

A first row names the columns, in any case and order: `EyeBlinkLeft`, `eyeBlink_L`. Time stands in `Timecode`
(HH:MM:SS:FF.fff) or `time` (seconds). Live Link Face adds the angles of the head and of both eyes.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from motionloom.datasets.base.files import write_text
from motionloom.datasets.motion.body.arkit import ARKIT, Floats
from motionloom.datasets.schema import UserError, read_plain

ANGLES = (
    "HeadYaw", "HeadPitch", "HeadRoll", "LeftEyeYaw", "LeftEyePitch", "LeftEyeRoll", "RightEyeYaw",
    "RightEyePitch", "RightEyeRoll",
)  # fmt: skip
"""Columns of the angles of head, left and right eye, in radians."""

_MOST_BYTES = 2**28
_TIMECODE = re.compile(r"(\d+):(\d+):(\d+):(\d+(?:\.\d*)?)")
_LARGEST_WEIGHT, _LARGEST_ANGLE = 1.5, 7.0
_WHOLE = 0.01
"""A measured rate so near to a whole number is that number."""


@dataclass(frozen=True, eq=False)
class FaceTake:
    """T frames at a steady rate."""

    weights: Floats
    """ARKit's weights [T, 52], in the order of `ARKIT`."""
    angles: Floats
    """[T, 9] in the order of `ANGLES`; zero where the file has none."""
    fps: float


def read_face(path: Path) -> FaceTake:
    """Read a take, resampled by time to its mean rate.

    `UserError` names the file, and the line or column that is wrong: no table, a missing shape, a row that is
    cut, NaN, weights in percent, time that stands still or goes back.
    """
    rows = _rows(path)
    columns = {_bare(name): number for number, name in enumerate(rows[0])}
    shapes = [columns.get(_bare(name), columns.get(_short(name), -1)) for name in ARKIT]
    if missing := [name for name, column in zip(ARKIT, shapes, strict=True) if column < 0]:
        raise UserError(
            f"{path}: no column for {', '.join(missing[:4])} ({len(missing)} of ARKit's 52 shapes)"
        )
    angles = [columns.get(_bare(name), -1) for name in ANGLES]
    for line, row in enumerate(rows[1:], start=2):
        if len(row) != len(rows[0]):
            raise UserError(f"{path}:{line}: {len(row)} columns, but the first line names {len(rows[0])}")
    weights = _numbers(
        path, rows, shapes, _LARGEST_WEIGHT, "weights lie between 0 and 1; divide percents by 100"
    )
    turned = _numbers(path, rows, angles, _LARGEST_ANGLE, "angles are in radians")
    times = _times(path, rows, columns)
    fps = (len(times) - 1) / (times[-1] - times[0])
    fps = float(round(fps)) if abs(fps / round(fps) - 1) < _WHOLE else float(fps)
    # Phones record at uneven intervals; a take is resampled at its mean rate.
    steady = times[0] + np.arange(int((times[-1] - times[0]) * fps + 1.5)) / fps
    both = np.concatenate([weights, turned], axis=1)
    even = np.stack([np.interp(steady, times, column) for column in both.T], axis=1)
    return FaceTake(even[:, : len(ARKIT)], even[:, len(ARKIT) :], fps)


def write_face(path: Path, take: FaceTake) -> None:
    """Write a take as Live Link Face does: timecode at 60 frames a second, weights, angles."""
    names = [name[0].upper() + name[1:] for name in ARKIT]
    lines = [",".join(["Timecode", "BlendshapeCount", *names, *ANGLES])]
    for frame, row in enumerate(np.concatenate([take.weights, take.angles], axis=1).tolist()):
        minutes, seconds = divmod(frame / take.fps, 60)
        hours, minutes = divmod(int(minutes), 60)
        code = f"{hours:02}:{minutes:02}:{int(seconds):02}:{seconds % 1 * 60:06.3f}"
        lines.append(",".join([code, str(len(row)), *(f"{value:.10f}" for value in row)]))
    write_text(path, "\n".join(lines) + "\n")


def _rows(path: Path) -> list[list[str]]:
    try:
        text = read_plain(path, _MOST_BYTES).decode("utf-8-sig")
        rows = [row for row in csv.reader(text.splitlines(), strict=True) if row]
    except OSError as error:
        raise UserError(f"{path}: cannot read ({error.strerror})") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path}: no table of text ({error})") from None
    if len(rows) < 3:
        raise UserError(
            f"{path}: {max(len(rows) - 1, 0)} frames; a take has a row of names and two frames or more"
        )
    return rows


def _numbers(
    path: Path, rows: Sequence[Sequence[str]], columns: Sequence[int], largest: float, hint: str
) -> Floats:
    """Columns [T, N] of the rows below the first; -1 is a column of zeros."""
    out = np.zeros((len(rows) - 1, len(columns)))
    for at, column in enumerate(columns):
        if column < 0:
            continue
        try:
            out[:, at] = [float(row[column]) for row in rows[1:]]
        except ValueError as error:
            raise UserError(f"{path}: column '{rows[0][column]}': {error}") from None
        wrong = np.flatnonzero(~(np.abs(out[:, at]) <= largest))  # true for NaN
        if len(wrong):
            value = rows[1 + wrong[0]][column][:20]
            raise UserError(f"{path}:{wrong[0] + 2}: {rows[0][column]} is {value}; {hint}")
    return out


def _times(path: Path, rows: Sequence[Sequence[str]], columns: dict[str, int]) -> Floats:
    """Seconds of every row."""
    column = columns.get("timecode", columns.get("time", columns.get("timestamp", -1)))
    if column < 0:
        raise UserError(f"{path}: no column of time (Timecode, or time in seconds)")
    codes = [_TIMECODE.fullmatch(row[column].strip()) for row in rows[1:]]
    found = [code for code in codes if code is not None]
    if len(found) == len(codes):
        parts = np.array([[float(part) for part in code.groups()] for code in found])
        times = parts[:, :3] @ [3600.0, 60.0, 1.0] + parts[:, 3] / (60.0 if parts[:, 3].max() >= 30 else 30.0)
    else:
        times = _numbers(path, rows, [column], 1e12, "time is HH:MM:SS:FF.fff or seconds")[:, 0]
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        raise UserError(f"{path}:{back[0] + 3}: time does not go on ({rows[back[0] + 2][column][:40]})")
    return np.asarray(times)


def _bare(name: str) -> str:
    return re.sub(r"[^a-z]", "", name.lower())


def _short(name: str) -> str:
    """`eyeblinkl` of `eyeBlinkLeft`."""
    return re.sub(r"(left|right)$", lambda side: side[0][0], _bare(name))
