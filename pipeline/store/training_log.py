"""`metrics.jsonl` of a stage: the rows of its training, finished or still going on."""

from __future__ import annotations

import json
from pathlib import Path

from motionloom.datasets.schema import UserError

FILE_NAME = "metrics.jsonl"


def read_training_log(folder: Path) -> list[dict[str, float]]:
    """Rows of a stage's log, each with "step" and figures such as "val/loss"; none where there is no log."""
    path = folder / FILE_NAME
    if not path.is_file():
        return []
    rows = []
    try:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            row = json.loads(line)
            if not isinstance(row, dict) or not isinstance(row.get("step"), int | float):
                raise UserError(f"{path}: line {number} is no row of a training log; delete the file")
            rows.append({k: float(v) for k, v in row.items() if isinstance(v, int | float)})
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:  # not UTF-8, or not JSON
        raise UserError(f"{path}: not a training log: {error}") from None
    return rows
