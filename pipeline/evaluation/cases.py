"""The worst and the best of what was evaluated, kept to be watched in the report **[ours]**.

`metrics.json` says who they are and how large their errors are, `cases.safetensors` beside it holds their
joints, so that nothing has to be generated again. Reconstructions are ordered by their MPJPE, generated
motions of the first repeat by the distance of TMA's latents of length 1 of motion and caption.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.pipeline.evaluation.truth import Truth
from motionloom.pipeline.render.viewer import ViewerMotion

FILE_NAME = "cases.safetensors"
EACH = 3
"""Clips kept as the worst, and as the best."""
_KINDS = {
    "reconstruction": (
        "mm",
        "Worst and best reconstructions",
        "Of all evaluated clips those that the tokenizer keeps worst and best: mean distance of the joints, "
        "root of each frame at one place.",
    ),
    "generated": (
        "from its words",
        "Worst and best generated motions",
        "Of all evaluated captions those whose generated motion is farthest from the words and nearest to "
        "them, by TMA's latents of length 1 (0: equal, 2: opposite); beside it the recorded motion.",
    ),
}
"""Kind of motion -> unit of its error, title, and note on the page."""


@dataclass(frozen=True)
class Clips:
    """A titled group of motions for the report's viewer."""

    title: str
    note: str
    motions: Sequence[ViewerMotion]


@dataclass(frozen=True)
class Case:
    """A clip, and what was made of it or for its caption."""

    of: str
    """Key of `_KINDS`."""
    place: str
    """"worst 1", "best 2", ..."""
    id: str
    caption: str
    error: float
    recorded: NDArray[np.floating]
    made: NDArray[np.floating]
    """Joints [T, N, 3] in metres, as are the recorded ones."""


def extreme_cases(
    of: str,
    truths: Sequence[Truth],
    errors: Sequence[float],
    motion_of: Callable[[int], NDArray[np.floating]],
) -> list[Case]:
    """The clips with the largest and the smallest errors; `made` gives joints [T, N, 3] by number."""
    return [
        Case(of, place, truths[k].id, truths[k].caption, errors[k], truths[k].joints, motion_of(k))
        for place, k in extremes(errors)
    ]


def extremes(errors: Sequence[float]) -> list[tuple[str, int]]:
    """(place, number) of the worst and the best, each number once; the worst first."""
    order = np.argsort(-np.asarray(errors), kind="stable").tolist()
    # Of few clips half are the worst and half the best.
    each = min(EACH, len(order) // 2 or len(order))
    worst = [(f"worst {k + 1}", number) for k, number in enumerate(order[:each])]
    best = [(f"best {k + 1}", number) for k, number in enumerate(reversed(order[-each:]))]
    return worst + [case for case in best if case[1] not in order[:each]]


def write_cases(folder: Path, cases: Sequence[Case], layout: MotionLayout) -> dict[str, Any]:
    """Write their joints, no file where there are none; what `metrics.json` says of them."""
    arrays = {}
    for number, case in enumerate(cases):
        arrays[f"{number}.recorded"] = np.ascontiguousarray(case.recorded, np.float32)
        arrays[f"{number}.made"] = np.ascontiguousarray(case.made, np.float32)
    (folder / FILE_NAME).unlink(missing_ok=True)
    if not arrays:
        return {}
    save_file(arrays, folder / FILE_NAME)
    described = [
        {"of": one.of, "place": one.place, "id": one.id, "caption": one.caption, "error": round(one.error, 3)}
        for one in cases
    ]
    return {"fps": layout.fps, "skeleton": layout.skeleton.name, "cases": described}


def shown_cases(folder: Path, details: Mapping[str, Any]) -> list[Clips]:
    """The motions beside `metrics.json`, as its `details` describe them; none without their file."""
    path, described = folder / FILE_NAME, details.get("cases", [])
    if not described or not path.is_file():
        return []
    motions: dict[str, list[ViewerMotion]] = {of: [] for of in _KINDS}
    try:
        arrays, parents = load_file(path), Skeleton.named(details["skeleton"]).parents
        for number, case in enumerate(described):
            of = str(case["of"])
            group = f"{case['place']}: {float(case['error']):.3g} {_KINDS[of][0]}"
            for label, key in (("recorded", "recorded"), (of, "made")):
                joints = arrays[f"{number}.{key}"]
                own, words = parents[: joints.shape[1]], str(case["caption"])
                motions[of].append(ViewerMotion(joints, details["fps"], own, label, words, group))
    except (SafetensorError, KeyError, OSError) as error:
        raise UserError(f"{path}: does not fit metrics.json beside it ({error}); evaluate again") from None
    return [Clips(title, note, motions[of]) for of, (_, title, note) in _KINDS.items() if motions[of]]
