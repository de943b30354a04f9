"""Where a model errs: errors of each joint, actions shown for others, the worst and best clips **[ours]**.

`metrics.json` holds all of it under `details`. The joints of the worst and the best clips lie beside it in
`cases.safetensors`, so that the page need not make them again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from motionloom.datasets.actions.measure import action_of, actions_of
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.layout import BODY_JOINTS, WRISTS
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.contract.showing import Confusions, JointErrors, Showing
from motionloom.pipeline.evaluation.clip_metrics import Joints, Performance
from motionloom.pipeline.evaluation.reconstruction import FINGERS
from motionloom.pipeline.evaluation.truth import Truth
from motionloom.pipeline.render.viewer import ViewerMotion

FILE_NAME = "cases.safetensors"
EACH = 3
"""Clips kept as the worst, and as the best."""
_CASES = {
    "reconstruction": ("Reconstructed worst and best", "MPJPE {:.0f} mm"),
    "generated": ("Generated worst and best, by the judge's latents", "{:.2f} from its words"),
}
"""What was made -> title of its clips, and what is said of each."""


@dataclass(frozen=True)
class Clips:
    """Motions to watch."""

    title: str
    motions: Sequence[ViewerMotion]


@dataclass(frozen=True)
class Case:
    """A clip, and what was made of it or for its caption."""

    of: str
    """Key of `_CASES`."""
    place: str
    """"worst 1", "best 2", ..."""
    truth: Truth
    error: float
    made: Joints
    """Joints [T, N, 3] in metres."""


def joint_distances(made: Joints, real: Joints) -> NDArray[np.float64]:
    """Mean error [N] in mm of each joint of [T, N, 3], with the root of each frame at the origin.

    Fingers have their own wrist there, as in `mpjpe_hand`.
    """
    off = made - real
    origin = np.zeros(off.shape[1], dtype=int)
    if len(origin) > BODY_JOINTS:
        for wrist, fingers in zip(WRISTS, FINGERS, strict=True):
            origin[list(fingers)] = wrist
    return np.asarray(1000 * np.linalg.norm(off - off[:, origin], axis=-1).mean(0))


def mean_distances(clips: NDArray[np.float64], frames: Sequence[int], skeleton: Skeleton) -> dict[str, float]:
    """Errors of n clips [n, N], NaN where a clip has no such joint, as one mean over all frames by joint."""
    there = np.isfinite(clips)
    weights = there * np.asarray(frames, dtype=float)[:, None]
    sums = (np.where(there, clips, 0.0) * weights).sum(0)
    return {
        name: round(total / weight, 2)
        for name, total, weight in zip(skeleton.joints, sums.tolist(), weights.sum(0).tolist(), strict=False)
        if weight
    }


def shown_actions(performances: Iterable[Performance]) -> NDArray[np.str_]:
    """The action that each motion shows, by geometry; "" where its clip does not state a single one."""
    found = [
        action_of(one.joints, one.fps) if len(actions_of(one.truth)) == 1 else "" for one in performances
    ]
    return np.array(found, dtype=np.str_)


def confusions(truths: Sequence[Truth], shown: Sequence[str]) -> dict[str, dict[str, int]]:
    """Asked for -> shown -> number of clips, of those that state a single action."""
    pairs = Counter((actions_of(t.truth)[0], str(act)) for t, act in zip(truths, shown, strict=True) if act)
    out: dict[str, dict[str, int]] = {}
    for (asked, act), count in sorted(pairs.items()):
        out.setdefault(asked, {})[act] = count
    return out


def extreme_cases(
    of: str, truths: Sequence[Truth], errors: Sequence[float], made: Callable[[int], Joints]
) -> list[Case]:
    """The clips with the largest and the smallest errors, each once, the worst first."""
    order = np.argsort(-np.asarray(errors), kind="stable").tolist()
    # Of few clips half are the worst and half the best.
    each = min(EACH, -(-len(order) // 2))
    worst = [(f"worst {place}", number) for place, number in enumerate(order[:each], start=1)]
    rest = order[each:][::-1][:EACH]
    best = [(f"best {place}", number) for place, number in enumerate(rest, start=1)]
    return [Case(of, place, truths[k], errors[k], made(k)) for place, k in worst + best]


def write_cases(folder: Path, cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Write their joints; returns what `metrics.json` says of them. Without cases there is no file."""
    arrays = {
        f"{number}.{label}": np.ascontiguousarray(joints, np.float32)
        for number, case in enumerate(cases)
        for label, joints in (("recorded", case.truth.joints), (case.of, case.made))
    }
    (folder / FILE_NAME).unlink(missing_ok=True)
    if arrays:
        save_file(arrays, folder / FILE_NAME)
    return [
        {
            "of": c.of,
            "place": c.place,
            "id": c.truth.id,
            "caption": c.truth.caption,
            "error": round(c.error, 3),
        }
        for c in cases
    ]


def showings(folder: Path, details: Mapping[str, Any]) -> list[Showing]:
    """All that the `details` of a `metrics.json` in `folder` describe; `UserError` where they do not fit."""
    try:
        return [*_joints(details), *_confusions(details), *_clips(folder, details)]
    except (SafetensorError, LookupError, TypeError, ValueError, AttributeError, OSError) as error:
        why = f"{type(error).__name__}: {error}"[:200]
        raise UserError(
            f"{folder}: metrics.json and {FILE_NAME} do not fit ({why}); evaluate again"
        ) from None


def _joints(details: Mapping[str, Any]) -> list[JointErrors]:
    errors = {name: float(value) for name, value in details.get("joints", {}).items()}
    title = "Reconstruction, error of each joint, mm"
    return [JointErrors(title, details["skeleton"], errors)] if errors else []


def _confusions(details: Mapping[str, Any]) -> list[Confusions]:
    return [
        Confusions(
            f"The action asked for (rows), and the one that {of} motion shows (columns), clips", counts
        )
        for of, counts in details.get("actions", {}).items()
        if counts
    ]


def _clips(folder: Path, details: Mapping[str, Any]) -> list[Clips]:
    described = details.get("cases", [])
    if not described:
        return []
    arrays, parents = load_file(folder / FILE_NAME), Skeleton.named(details["skeleton"]).parents
    out: dict[str, list[ViewerMotion]] = {of: [] for of in _CASES}
    for number, case in enumerate(described):
        of = case["of"]
        group = f"{case['place']}: {_CASES[of][1].format(case['error'])} ({case['id']})"
        for label in ("recorded", of):
            joints = arrays[f"{number}.{label}"]
            own = parents[: joints.shape[1]]
            out[of].append(ViewerMotion(joints, details["fps"], own, label, case["caption"], group))
    return [Clips(_CASES[of][0], motions) for of, motions in out.items() if motions]
