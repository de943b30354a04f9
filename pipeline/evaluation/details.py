"""What an evaluation keeps beside its figures, to be drawn: joints' errors, confusions, worst and best.

`joint_errors_mm`: each joint's distance with the root of each frame moved to the origin, as `mpjpe` has it,
mean over the frames of all clips; where every clip has hands, the mean over joints is `mpjpe`.
`hand_joint_errors_mm`: the finger joints' from their wrist, as `mpjpe_hand` has it, left hand first.

`metrics.json` gets who the worst and best are and how large their errors are (`cases`), `cases.safetensors`
beside it the joints, so that nothing has to be generated again. Reconstructions are ordered by the mean
distance of their joints, generated motions of the first repeat by the distance of TMA's latents of length 1
of motion and caption.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import BODY_JOINTS, WRISTS, MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import HANDS, UserError
from motionloom.pipeline.contract.showing import JointErrors, Matrix, Showing
from motionloom.pipeline.evaluation.confusions import measured_confusions, retrieval_confusions
from motionloom.pipeline.evaluation.latent_metrics import Latents, caption_distances
from motionloom.pipeline.evaluation.truth import Truth, reconstruct_truth
from motionloom.pipeline.render.labels import label
from motionloom.pipeline.render.viewer import ViewerMotion
from motionloom.pipeline.store.networks import TrainedTokenizer

DIGITS = 2
_MOTIONS = {"generated": "generated motion", "real": "recorded motion"}
_MADE = {
    "reconstruction": ("reconstruction", "Worst and best reconstructions"),
    "generated": ("generated", "Worst and best generated motions"),
}
_NOTES = {
    "reconstruction": "Of all evaluated clips those that the tokenizer keeps worst and best: mean distance "
    "of the joints, root of each frame at one place.",
    "generated": "Of all evaluated captions those whose generated motion is farthest from the words and "
    "nearest to them, by TMA's latents of length 1 (0: equal, 2: opposite); beside it the recorded motion.",
}


@dataclass(frozen=True)
class Clips:
    """Motions to watch."""

    title: str
    note: str
    motions: Sequence[ViewerMotion]


@dataclass
class Details:
    """Gathered while figures are taken."""

    layout: MotionLayout
    split: str
    cases: list[Case] = field(default_factory=list)
    confusions: list[dict[str, Any]] = field(default_factory=list)
    joints: dict[str, Any] = field(default_factory=dict)

    def reconstructed(self, tokenizer: TrainedTokenizer, truths: Sequence[Truth]) -> None:
        """Each joint's error, and the worst and best clips."""
        found = joint_map(tokenizer, truths)
        self.joints = {"reconstructed_clips": len(truths), **found.figures}
        self.cases += reconstructed_cases(tokenizer, truths, found.clips)

    def judged(self, latents: Latents, truths: Sequence[Truth], joints: Sequence[NDArray[Any]]) -> None:
        """What captions are taken for, and the worst and best motions [T, N, 3] of the first repeat."""
        self.confusions += retrieval_confusions(latents, truths)
        far = caption_distances(latents.text, latents.made[0]).tolist()
        self.cases += generated_cases(truths, joints, far)

    def performed(self, truths: Sequence[Truth], joints: Sequence[NDArray[Any]]) -> None:
        """The actions that the motions of the first repeat show."""
        self.confusions += measured_confusions(truths, joints, self.layout.fps)

    def record(self) -> dict[str, Any]:
        """What `metrics.json` gets."""
        out = {
            "split": self.split,
            "fps": self.layout.fps,
            "skeleton": self.layout.skeleton.name,
            **self.joints,
            "confusions": self.confusions,
        }
        return out | ({"cases": [case.record() for case in self.cases]} if self.cases else {})


@dataclass(frozen=True)
class JointMapFigures:
    """Errors of joints, and of clips."""

    figures: dict[str, Any]
    """What `metrics.json` gets; None stands for joints that no clip has."""
    clips: list[float]
    """Of each clip, mean over its joints and frames, mm."""


def joint_map(tokenizer: TrainedTokenizer, truths: Sequence[Truth]) -> JointMapFigures:
    """Errors of the reconstructions of `truths`."""
    joints = tokenizer.layout.num_joints
    sums, frames = np.zeros(joints), np.zeros(joints)
    fingers = np.zeros(joints - BODY_JOINTS)
    clips = []
    for truth in truths:
        made = joints_of(reconstruct_truth(tokenizer, truth), tokenizer.layout)
        there = joints if truth.present & HANDS else BODY_JOINTS
        each = distances(made, truth.joints)[:, :there]
        clips.append(float(each.mean()))
        sums[:there] += each.sum(0)
        frames[:there] += len(each)
        if there > BODY_JOINTS:
            fingers += finger_distances(made, truth.joints).sum(0)
    figures: dict[str, Any] = {"joint_errors_mm": _means(sums, frames)}
    if len(fingers) and frames[-1]:
        figures["hand_joint_errors_mm"] = _means(fingers, frames[BODY_JOINTS:])
    return JointMapFigures(figures, clips)


def distances(made: NDArray[Any], real: NDArray[Any]) -> NDArray[np.float64]:
    """Distance of each joint of [T, N, 3] metres from its own, roots at the origin: [T, N] mm."""
    return _lengths((made - made[:, :1]) - (real - real[:, :1]))


def finger_distances(made: NDArray[Any], real: NDArray[Any]) -> NDArray[np.float64]:
    """Likewise of the finger joints, each hand's wrist at the origin: [T, N - 22] mm."""
    count = (made.shape[1] - BODY_JOINTS) // len(WRISTS)
    out = []
    for hand, wrist in enumerate(WRISTS):
        fingers = slice(BODY_JOINTS + hand * count, BODY_JOINTS + (hand + 1) * count)
        local = [motion[:, fingers] - motion[:, wrist : wrist + 1] for motion in (made, real)]
        out.append(_lengths(local[0] - local[1]))
    return np.concatenate(out, axis=1)


def _lengths(difference: NDArray[Any]) -> NDArray[np.float64]:
    return np.asarray(1000 * np.linalg.norm(difference.astype(np.float64), axis=-1))


def _means(sums: NDArray[np.float64], frames: NDArray[np.float64]) -> list[float | None]:
    pairs = zip(sums.tolist(), frames.tolist(), strict=True)
    return [round(total / count, DIGITS) if count else None for total, count in pairs]


def detail_showings(folder: Path, figures: Mapping[str, Any]) -> list[Showing]:
    """Drawings of the details in `metrics.json`, and of the motions beside it."""
    out: list[Showing] = []
    if "joint_errors_mm" in figures:
        clips = f"{figures['reconstructed_clips']} {figures['split']} clips"
        out.append(
            JointErrors(
                f"Where reconstructions err: mean error of each joint over {clips}, mm",
                figures["skeleton"],
                figures["joint_errors_mm"],
                figures.get("hand_joint_errors_mm", ()),
            )
        )
    out += [_matrix(found) for found in figures.get("confusions", [])]
    cases = read_cases(folder, figures.get("cases", []))
    for of, (name, title) in _MADE.items():
        chosen = [case for case in cases if case.of == of]
        if chosen:
            motions = [motion for case in chosen for motion in _pair(case, name, figures)]
            out.append(Clips(title, _NOTES[of], motions))
    return out


def _matrix(found: dict[str, Any]) -> Matrix:
    about, motion = found["about"], _MOTIONS[found["of"]]
    title, corner = f"Taken for which {about}", f"own {about} ↓ taken for →"
    if found["by"] == "joints":
        title = f"The action that is asked for, and what the joints of the {motion} show"
        corner = "asked for ↓ shown →"
    else:
        title += f": the nearest of {found['captions']} captions to each {motion}"
    rows, columns = (
        [name if about == "caption" else label(name) for name in found[side]] for side in ("rows", "columns")
    )
    return Matrix(title, corner, rows, columns, found["counts"])


def _pair(case: Case, made: str, figures: Mapping[str, Any]) -> list[ViewerMotion]:
    unit = " mm" if case.of == "reconstruction" else " from its words"
    group = f"{case.place}: {case.error:.3g}{unit}"
    parents = Skeleton.named(figures["skeleton"]).parents[: case.recorded.shape[1]]
    return [
        ViewerMotion(joints, figures["fps"], parents, name, case.caption, group)
        for name, joints in (("recorded", case.recorded), (made, case.made))
    ]


# The worst and the best of what was evaluated.

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

    def record(self) -> dict[str, Any]:
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


def read_cases(folder: Path, found: Sequence[Mapping[str, Any]]) -> list[Case]:
    """Those that an evaluation kept, by its `cases` in `metrics.json`; none where their file is not there."""
    path = folder / FILE_NAME
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
