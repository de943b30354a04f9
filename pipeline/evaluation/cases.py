"""The worst and the best of what was evaluated, kept so that a page can show them: figures and motions.

`metrics.json` gets who they are and how large their errors are (`cases`), `cases.safetensors` beside it the
joints, so that nothing has to be generated again. Reconstructions are ordered by the mean distance of their
joints, generated motions of the first repeat by the distance of TMA's latents of length 1 of motion and
caption.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from motionloom.datasets.motion.joints import joints_of
from motionloom.datasets.schema import UserError
from motionloom.pipeline.evaluation.truth import Truth, reconstruct_truth
from motionloom.pipeline.store.networks import TrainedTokenizer

FILE_NAME = "cases.safetensors"
EACH = 3
"""Of the worst, and of the best."""
UNITS = {"reconstruction": "mm", "generated": "latent distance"}


@dataclass(frozen=True)
class Case:
    """A clip, and what was made of it or for its caption."""

    of: str
    """Of `UNITS`."""
    place: str
    """"worst 1", "best 2", ..."""
    id: str
    caption: str
    error: float
    recorded: NDArray[Any]
    made: NDArray[Any]
    """Joints [T, N, 3] in metres, as are the recorded ones."""

    def figures(self) -> dict[str, Any]:
        """What `metrics.json` says of it."""
        return {
            "of": self.of,
            "place": self.place,
            "id": self.id,
            "caption": self.caption,
            "error": round(self.error, 3),
            "unit": UNITS[self.of],
        }


def extremes(errors: Sequence[float]) -> list[tuple[str, int]]:
    """(place, number) of the worst and the best, each number once; the worst first."""
    order = np.argsort(-np.asarray(errors), kind="stable").tolist()
    each = min(EACH, len(order) // 2 or len(order))
    worst = [(f"worst {k + 1}", number) for k, number in enumerate(order[:each])]
    best = [(f"best {k + 1}", number) for k, number in enumerate(reversed(order[-each:]))]
    return worst + [case for case in best if case[1] not in order[:each]]


def reconstructed_cases(
    tokenizer: TrainedTokenizer, truths: Sequence[Truth], errors: Sequence[float]
) -> list[Case]:
    """Of reconstructions with these errors."""
    out = []
    for place, k in extremes(errors):
        truth = truths[k]
        made = joints_of(reconstruct_truth(tokenizer, truth), tokenizer.layout)
        case = Case("reconstruction", place, truth.id, truth.caption, errors[k], truth.joints, made)
        out.append(case)
    return out


def generated_cases(
    truths: Sequence[Truth], motions: Sequence[NDArray[Any]], errors: Sequence[float]
) -> list[Case]:
    """Of motions generated for the captions of `truths`."""
    return [
        Case("generated", place, truths[k].id, truths[k].caption, errors[k], truths[k].joints, motions[k])
        for place, k in extremes(errors)
    ]


def write_cases(folder: Path, cases: Sequence[Case]) -> None:
    """Write their joints; no file where there are none."""
    arrays = {}
    for number, case in enumerate(cases):
        arrays[f"{number}.recorded"] = np.ascontiguousarray(case.recorded, np.float32)
        arrays[f"{number}.made"] = np.ascontiguousarray(case.made, np.float32)
    (folder / FILE_NAME).unlink(missing_ok=True)
    if arrays:
        save_file(arrays, folder / FILE_NAME)


def read_cases(folder: Path, figures: Mapping[str, Any]) -> list[Case]:
    """Those that an evaluation kept; none of one by an earlier version."""
    path, found = folder / FILE_NAME, figures.get("cases", [])
    if not found or not path.is_file():
        return []
    try:
        arrays = load_file(path)
        return [
            Case(
                of=str(case["of"]),
                place=str(case["place"]),
                id=str(case["id"]),
                caption=str(case["caption"]),
                error=float(case["error"]),
                recorded=arrays[f"{number}.recorded"],
                made=arrays[f"{number}.made"],
            )
            for number, case in enumerate(found)
        ]
    except (SafetensorError, KeyError, OSError) as error:
        raise UserError(f"{path}: does not fit metrics.json beside it ({error}); evaluate again") from None
