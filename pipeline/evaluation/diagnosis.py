"""Where a model errs: errors of each joint, actions shown for others, the worst and best clips **[ours]**.

`metrics.json` holds all of it under `details`. The joints of the worst and the best clips lie beside it in
`cases.safetensors`, so that the page need not make them again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from motionloom.datasets.actions.measure import action_of, actions_of
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_bytes
from motionloom.datasets.motion.layout import BODY_JOINTS, FINGERS, WRISTS, MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.contract.showing import Confusions, JointErrors, Showing
from motionloom.pipeline.contract.units import Arrays
from motionloom.pipeline.evaluation.clip_metrics import Joints, Performance
from motionloom.pipeline.evaluation.truth import Truth
from motionloom.pipeline.render.viewer import Clips, ViewerMotion

FILE_NAME = "cases.safetensors"
_ACTION = "action"
_MOTION = "motion/"
EACH = 3
"""Clips kept as the worst, and as the best."""
_CASES = {
    "reconstruction": ("Reconstructed worst and best", "MPJPE {:.0f} mm"),
    "generated": ("Generated worst and best, by the judge's latents", "{:.2f} from its words"),
}
"""What was made -> title of its clips, and what is said of each."""


class Diagnosis:
    """Collects where a model errs; `write` gives what `metrics.json` says of it."""

    def __init__(self, layout: MotionLayout) -> None:
        self.skeleton = layout.skeleton
        self.details: dict[str, Any] = {
            "fps": layout.fps, "skeleton": layout.skeleton.name, "actions": {}, "cases": []
        }  # fmt: skip
        self._arrays: dict[str, NDArray[np.float32]] = {}

    def take_distances(self, clips: NDArray[np.float64], frames: Sequence[int]) -> None:
        """Note errors of n clips [n, N], NaN where one has no such joint: a mean over frames by joint."""
        long = np.asarray(frames, dtype=float)[:, None]
        counts = (np.isfinite(clips) * long).sum(0).tolist()
        sums = np.nansum(clips * long, axis=0).tolist()
        named = zip(self.skeleton.joints, sums, counts, strict=False)
        self.details["joints"] = {name: round(total / count, 2) for name, total, count in named if count}

    def take(
        self, of: str, truths: Sequence[Truth], tables: Sequence[Arrays], errors: Sequence[float]
    ) -> None:
        """Note what was made of clips or for their captions: confusions of actions, and the motions with the
        largest and the smallest errors. Of several judges the first one's errors stay.

        Args:
            of: Key of `_CASES`.
            truths: The n clips.
            tables: `as_shown` of what was made, in their order.
            errors: [n].
        """
        if of in self.details["actions"]:
            return
        actions = np.concatenate([table[_ACTION] for table in tables]).tolist()
        self.details["actions"][of] = confusions(truths, actions)
        made = [table[name] for table in tables for name in sorted(table) if name.startswith(_MOTION)]
        for place, k in extremes(errors):
            number = len(self.details["cases"])
            truth = truths[k]
            self._arrays |= {
                f"{number}.recorded": np.ascontiguousarray(truth.joints, np.float32),
                f"{number}.{of}": made[k],
            }
            case = {"of": of, "place": place, "id": truth.id, "caption": truth.caption}
            self.details["cases"].append(case | {"error": round(errors[k], 3)})

    def write(self, folder: Path) -> dict[str, Any]:
        """Write the motions, no file where there are none; returns what describes them and the rest."""
        (folder / FILE_NAME).unlink(missing_ok=True)
        if self._arrays:
            write_bytes(folder / FILE_NAME, save(self._arrays))
        return self.details


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


def as_shown(performances: Sequence[Performance]) -> Arrays:
    """Motions, and the action that each shows by geometry; "" where its clip does not state a single one."""
    actions = [
        action_of(one.joints, one.fps) if len(actions_of(one.truth)) == 1 else "" for one in performances
    ]
    motions = {f"{_MOTION}{k:03d}": one.joints.astype(np.float32) for k, one in enumerate(performances)}
    return {_ACTION: np.array(actions, dtype=np.str_), **motions}


def confusions(truths: Sequence[Truth], shown: Sequence[str]) -> dict[str, dict[str, int]]:
    """Asked for -> shown -> number of clips, of those that state a single action."""
    pairs = Counter((actions_of(t.truth)[0], act) for t, act in zip(truths, shown, strict=True) if act)
    out: dict[str, dict[str, int]] = {}
    for (asked, act), count in sorted(pairs.items()):
        out.setdefault(asked, {})[act] = count
    return out


def extremes(errors: Sequence[float]) -> list[tuple[str, int]]:
    """(place, number) of the largest and of the smallest errors, each number once, the worst first."""
    order = np.argsort(-np.asarray(errors), kind="stable").tolist()
    # Of few clips half are the worst and half the best.
    each = min(EACH, -(-len(order) // 2))
    worst = [(f"worst {place}", number) for place, number in enumerate(order[:each], start=1)]
    rest = order[each:][::-1][:EACH]
    return worst + [(f"best {place}", number) for place, number in enumerate(rest, start=1)]


def showings(folder: Path, details: Mapping[str, Any]) -> list[Showing]:
    """All that the `details` of a `metrics.json` in `folder` describe; `UserError` where they do not fit."""
    if not details:
        return []
    try:
        skeleton = Skeleton.named(details["skeleton"])
        out: list[Showing] = []
        if joints := details.get("joints"):
            title = "Reconstruction, mm at each joint, its right hand on your left"
            out.append(JointErrors(title, skeleton, joints))
        for of, counts in details["actions"].items():
            if counts:
                out.append(Confusions(f"Actions asked for (rows) and shown (columns), {of}, clips", counts))
        return out + _clips(folder, details, skeleton)
    except (SafetensorError, LookupError, TypeError, ValueError, AttributeError, OSError) as error:
        why = f"{type(error).__name__}: {error}"[:200]
        raise UserError(
            f"{folder}: metrics.json and {FILE_NAME} do not fit ({why}); evaluate again"
        ) from None


def _clips(folder: Path, details: Mapping[str, Any], skeleton: Skeleton) -> list[Clips]:
    described = details["cases"]
    arrays = load_file(folder / FILE_NAME) if described else {}
    out: dict[str, list[ViewerMotion]] = {of: [] for of in _CASES}
    for number, case in enumerate(described):
        of = case["of"]
        group = f"{case['place']}: {_CASES[of][1].format(case['error'])} ({case['id']})"
        for label in ("recorded", of):
            joints = arrays[f"{number}.{label}"]
            own = skeleton.parents[: joints.shape[1]]
            out[of].append(ViewerMotion(joints, details["fps"], own, label, case["caption"], group))
    return [Clips(_CASES[of][0], motions) for of, motions in out.items() if motions]
