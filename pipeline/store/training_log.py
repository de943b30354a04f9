"""Logs of a training beside its network: `metrics.jsonl`, `flight/rank_N.jsonl`, `flight/starts.jsonl`.

The flight logs hold times and are no output.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import parse_json, read_plain
from motionloom.pipeline.store.files import open_own

FILE_NAME = "metrics.jsonl"
FLIGHT = "flight"
"""Folder of the flight logs, in a stage's."""
STARTS = "starts.jsonl"
"""File in that folder, of the steps at which the training began and went on."""
SAMPLES, SAMPLE_FIGURES = "samples", "figures.jsonl"
"""Folder of the motions that are drawn meanwhile, in a stage's, and the file of their figures in it."""


@contextmanager
def optional(what: str, console: Console) -> Iterator[None]:
    """Keep an error in what no result depends on from ending a training: one warning says what and why."""
    try:
        yield
    except Exception as error:
        cause = str(error) or error.__cause__ or error.__context__ or ""
        reason = f"{type(error).__name__}: {cause}".partition("\n")[0].rstrip(": ")
        console.print(f"[yellow]    {escape(f'{what} is left out: {reason}')}[/]", soft_wrap=True)


def read_training_log(folder: Path) -> list[dict[str, float]]:
    """Rows of a stage's log, each with "step" and figures such as "val/loss"; none where there is no log."""
    path = folder / FILE_NAME
    if not path.is_file():
        return []
    rows = []
    try:
        for number, line in enumerate(read_plain(path).splitlines(), start=1):
            row = parse_json(line, f"{path}: not a training log: line {number}", parse_constant=float)
            if not isinstance(row, dict) or not isinstance(row.get("step"), int | float):
                raise UserError(f"{path}: line {number} is no row of a training log; delete the file")
            rows.append({k: float(v) for k, v in row.items() if isinstance(v, int | float)})
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    return rows


_RISE = 1e3
"""Times above its start at which a loss has risen for good."""


def rise_of_loss(rows: Sequence[Mapping[str, float]]) -> str | None:
    """A sentence where the loss of a training ends a thousand times above its start; else None."""
    losses = [row["train/loss"] for row in rows if "train/loss" in row]
    if not losses or losses[-1] <= _RISE * abs(losses[0]):
        return None
    return f"the loss ended at {losses[-1]:.3g}, {losses[-1] / (abs(losses[0]) or 1):,.0f} times its start"


def read_rows(path: Path) -> list[dict[str, float]]:
    """Rows of a flight log; none where there is no file. A line that a kill has cut short is left out."""
    if not path.is_file():
        return []
    rows = []
    for line in read_plain(path).splitlines():
        try:
            row = parse_json(line, str(path), parse_constant=float)
        except UserError:
            continue
        if isinstance(row, dict) and isinstance(row.get("step"), int):
            rows.append({name: value for name, value in row.items() if isinstance(value, int | float)})
    return rows


def read_flight(folder: Path) -> dict[int, list[dict[str, float]]]:
    """The flight logs in a stage's folder, by rank."""
    ranks = {}
    for path in sorted((folder / FLIGHT).glob("rank_*.jsonl")):
        rank = path.stem.removeprefix("rank_")
        if rank.isdecimal() and (rows := read_rows(path)):
            ranks[int(rank)] = rows
    return ranks


def note_start(folder: Path, step: int, reached: int) -> None:
    """Note beside the flight logs that a training begins or goes on at `step`, having `reached` another.

    No output either, so that a training that was killed leaves the same files as an undisturbed one.
    """
    with open_own(folder / FLIGHT / STARTS, "a") as file:
        file.write(json.dumps({"step": step, "reached": reached}) + "\n")


def read_starts(folder: Path) -> list[tuple[int, int]]:
    """(step, step reached before) of each time that a training went on, the first one left out."""
    rows = read_rows(folder / FLIGHT / STARTS)
    return [(int(row["step"]), int(row["reached"])) for row in rows[1:] if "reached" in row]


def seconds_trained(folder: Path) -> float:
    """Seconds that a training has taken up to its last row, in all its processes one after the other."""
    rows = read_rows(folder / FLIGHT / "rank_0.jsonl")
    return rows[-1].get("elapsed_seconds", 0.0) if rows else 0.0
