"""What an evaluation found beside its tables, as the report draws it: joints, confusions, cases."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.contract.showing import Clips, JointMap, Matrix, Showing
from motionloom.pipeline.evaluation.cases import Case, read_cases
from motionloom.pipeline.render.labels import label
from motionloom.pipeline.render.viewer import ViewerMotion

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


def detail_showings(folder: Path, figures: dict[str, Any]) -> list[Showing]:
    """Drawings of `metrics.json` and of the motions beside it; an earlier version's has none."""
    out: list[Showing] = []
    if "joint_errors_mm" in figures:
        clips = f"{figures['reconstructed_clips']} {figures['split']} clips"
        out.append(
            JointMap(
                f"Where reconstructions err: mean error of each joint over {clips}, mm",
                figures["skeleton"],
                figures["joint_errors_mm"],
                figures.get("hand_joint_errors_mm", ()),
            )
        )
    out += [_matrix(found) for found in figures.get("confusions", [])]
    cases = read_cases(folder, figures)
    for of, (name, title) in _MADE.items():
        chosen = [case for case in cases if case.of == of]
        if chosen:
            motions = [motion for case in chosen for motion in _pair(case, name, figures)]
            out.append(Clips(title, _NOTES[of], motions))
    return out


def _matrix(found: dict[str, Any]) -> Matrix:
    about = "genre of a dance" if found["about"] == "genre" else label(found["about"])
    motion = _MOTIONS[found["of"]]
    if found["by"] == "joints":
        title = f"The action that is asked for, and what the joints of the {motion} show"
        corner = "asked for ↓ shown →"
    elif found["about"] == "caption":
        title = f"Captions confused most often: the nearest of {found['captions']} captions to each {motion}"
        corner = "own caption ↓ taken for →"
    else:
        title = f"Taken for which {about}: the nearest of {found['captions']} captions to each {motion}"
        corner = f"own {about} ↓ taken for →"
    return Matrix(
        title,
        corner,
        [name if found["about"] == "caption" else label(name) for name in found["rows"]],
        [name if found["about"] == "caption" else label(name) for name in found["columns"]],
        found["counts"],
        more=found["about"] not in ("action", "caption"),
    )


def _pair(case: Case, made: str, figures: dict[str, Any]) -> list[ViewerMotion]:
    unit = " mm" if case.of == "reconstruction" else " from its words"
    group = f"{case.place}: {case.error:.3g}{unit}"
    parents = Skeleton.named(figures["skeleton"]).parents[: case.recorded.shape[1]]
    return [
        ViewerMotion(joints, figures["fps"], parents, name, case.caption, group)
        for name, joints in (("recorded", case.recorded), (made, case.made))
    ]
