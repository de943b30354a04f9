"""Which metric notices which fault: figures of recorded motion that is made worse on purpose.

    motionloom run ude-dance
    python benchmarks/perturbation.py runs/ude-dance

Recorded test clips, each with a fault of `FAULTS`, or with another clip's motion, are
judged as generated motion is. Distances are to as many training clips, so that recorded motion has a value
too. Everything is measured on ten random halves of the clips. A metric has noticed a fault ("+") where it is
worse than for the recorded motion of the same half in all ten, by more than twice the deviation that
recorded motion has among halves; it is deceived ("!") where it is better by as much; "." is neither.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch.nn.functional import normalize

from motionloom.datasets.motion.canonical import mirror
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.models.metrics.distributions import diversity, fid
from motionloom.models.metrics.retrieval import matching_score
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.clip_metrics import (
    BEAT_ALIGN,
    RECOGNITION,
    Performance,
    agreement,
    floor_and_jerk,
    measure_clip,
)
from motionloom.pipeline.evaluation.dances import DanceClip, dances_of
from motionloom.pipeline.evaluation.estimate import row_estimates
from motionloom.pipeline.evaluation.latent_metrics import LatentRow, recalls
from motionloom.pipeline.evaluation.movement import all_features, distances
from motionloom.pipeline.evaluation.reconstruction import published_errors
from motionloom.pipeline.evaluation.truth import Truth, drawn, has_caption, spread_any, truth_of
from motionloom.pipeline.store.networks import LoadedTma, embed_motions

Joints = NDArray[np.float64]
Fault = Callable[[Joints, float, np.random.Generator], Joints]
"""Of joints, frames a second and random numbers."""


def noise(metres: float) -> Fault:
    """Every joint of every frame elsewhere, by a normal deviate."""
    return lambda joints, fps, rng: joints + rng.normal(0.0, metres, joints.shape)


def frozen(joints: Joints, fps: float, rng: np.random.Generator) -> Joints:
    """The first frame for the whole time."""
    return np.repeat(joints[:1], len(joints), axis=0)


def late(seconds: float) -> Fault:
    """The motion begins later and ends where time is up; until then it stands in its first frame."""

    def change(joints: Joints, fps: float, rng: np.random.Generator) -> Joints:
        wait = min(len(joints) - 1, round(seconds * fps))
        return np.concatenate([np.repeat(joints[:1], wait, axis=0), joints[: len(joints) - wait]])

    return change


def backwards(joints: Joints, fps: float, rng: np.random.Generator) -> Joints:
    """From the last frame to the first."""
    return joints[::-1].copy()


def mirrored(joints: Joints, fps: float, rng: np.random.Generator) -> Joints:
    """Left and right exchanged."""
    name = {22: "smpl22", 52: "smplx52"}[joints.shape[1]]
    return np.asarray(mirror(joints, Skeleton.named(name)))


def gliding(metres_a_second: float) -> Fault:
    """The whole figure glides forward over the floor beside what it does."""

    def change(joints: Joints, fps: float, rng: np.random.Generator) -> Joints:
        out = joints.copy()
        out[..., 2] += (np.arange(len(joints)) * metres_a_second / fps)[:, None]
        return out

    return change


def raised(metres: float) -> Fault:
    """Above the floor, or below it where negative."""

    def change(joints: Joints, fps: float, rng: np.random.Generator) -> Joints:
        out = joints.copy()
        out[..., 1] += metres
        return out

    return change


FAULTS: Mapping[str, Fault] = {
    "noise of 1 cm": noise(0.01),
    "noise of 5 cm": noise(0.05),
    "frozen": frozen,
    "0.3 s late": late(0.3),
    "backwards": backwards,
    "mirrored": mirrored,
    "gliding 0.6 m/s": gliding(0.6),
    "5 cm above the floor": raised(0.05),
    "3 cm in the floor": raised(-0.03),
}
"""By name, as tables have it."""


def swapped(count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Whose motion each of `count` clips has: nobody its own, [n]."""
    order = rng.permutation(count)
    out = np.empty(count, dtype=np.int64)
    out[order] = np.roll(order, 1)
    return out


HALVES = 10
SWAPPED = "another clip's motion"
BETTER = {
    "R@1": 1, "Matching score": -1, "FID": -1, "FID, length 1": -1, "Diversity": 0, "obeys its caption": 1,
    "MPJPE": -1, "PA-MPJPE": -1, "ACCEL": -1, "skating": -1, "floating": -1, "penetration": -1, "jitter": -1,
    "Beat Align (UDE)": 1, "Beat Align (MINT)": 1, "FID_k": -1, "FID_m": -1, "genre": 1,
}  # fmt: skip
"""Direction in which a metric is better; 0: the nearer to recorded motion."""

Figures = dict[str, float]


@dataclass
class Captioned:
    """Test clips with captions, and what judges them."""

    tma: LoadedTma
    truths: list[Truth]
    text: torch.Tensor
    others: torch.Tensor

    def figures(self, motions: Sequence[Joints], size: int) -> Callable[[NDArray[np.int64]], Figures]:
        """Figures of any of the clips, by their numbers."""
        layout, fps = self.tma.layout, self.tma.layout.fps
        columns = layout.part("bodyhand")
        latent = embed_motions(self.tma, [encode(m, layout)[:, columns] for m in motions])
        pairs = zip(self.truths, motions, strict=True)
        made = [Performance(m, t.joints, fps, truth=t.truth) for t, m in pairs]
        kept, bodies = [agreement(one) for one in made], [floor_and_jerk(one) for one in made]
        errors = [
            published_errors(torch.from_numpy(m), torch.from_numpy(t.joints))[""].means()
            for t, m in zip(self.truths, motions, strict=True)
        ]

        def of(rows: NDArray[np.int64]) -> Figures:
            text, motion = self.text[rows], latent[rows]
            draws = [recalls(LatentRow(text, text, motion, seed, size)) for seed in range(5)]
            obeys = means([kept[r] for r in rows])
            obeys.pop("agreement.everything", None)
            out = {
                "R@1": float(np.mean([found["t2m_r1"] for found in draws])),
                "Matching score": float(matching_score(unit(text), unit(motion))),
                "FID": float(fid(self.others, motion)),
                "FID, length 1": float(fid(unit(self.others), unit(motion))),
                "Diversity": float(diversity(motion, seed=0)),
            }
            out |= {"obeys its caption": float(np.mean(list(obeys.values())))} if obeys else {}
            mean = means([errors[r] for r in rows])
            out |= {"MPJPE": mean["mpjpe"], "PA-MPJPE": mean["pa_mpjpe"], "ACCEL": mean["accel"]}
            return out | {k.partition(".")[2]: v for k, v in means([bodies[r] for r in rows]).items()}

        return of


@dataclass
class Dances:
    """Test dances, and training dances that distances are to."""

    clips: list[DanceClip]
    pool: list[Joints]

    def figures(self, motions: Sequence[Joints]) -> Callable[[NDArray[np.int64]], Figures]:
        """Figures of any of the clips, by their numbers."""
        fps = self.clips[0].fps
        true, found = all_features(self.pool, fps), all_features(motions, fps)

        def of(rows: NDArray[np.int64]) -> Figures:
            clips = [(motions[r], self.clips[r]) for r in rows]
            each = [Performance(m, c.joints, fps, truth=c.truth, beats=c.beats) for m, c in clips]
            mean = means([measure_clip((BEAT_ALIGN, RECOGNITION), one) for one in each])
            apart = distances(true, {kind: values[rows] for kind, values in found.items()})
            out = {f"Beat Align ({n.upper()})": mean[f"beat_align.{n}"] for n in ("ude", "mint")}
            out |= {f"FID_{kind}": apart[f"movement.fid_{kind}"] for kind in "km"}
            return out | {k.partition(".")[2]: v for k, v in mean.items() if k == "recognition.genre"}

        return of


def means(rows: Sequence[Mapping[str, float]]) -> Figures:
    """Mean of each value over the clips that have it."""
    return {name: found.value for name, found in row_estimates([rows]).items()}


def unit(latents: torch.Tensor) -> torch.Tensor:
    """Of length 1."""
    return normalize(latents.double(), dim=-1)


def verdicts(clean: list[Figures], faulty: list[Figures]) -> dict[str, tuple[float, str]]:
    """Mean of each figure with the fault, and whether it was noticed."""
    out = {}
    for name in faulty[0]:
        before = np.array([row[name] for row in clean])
        after = np.array([row[name] for row in faulty])
        gain = (after - before) * BETTER[name] if BETTER[name] else -np.abs(after - before)
        clear = np.abs(gain).mean() > max(2 * before.std(ddof=1), 1e-9)
        mark = "+" if clear and (gain < 0).all() else "!" if clear and (gain > 0).all() else "."
        out[name] = (float(after.mean()), mark)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--clips", type=int, default=400, help="captioned test clips, and dances, at most")
    parser.add_argument("--size", type=int, default=32, help="candidates of retrieval")
    args = parser.parse_args()
    stages, stage_cache = finished_stages(args.run), StageCache()
    tma, data = stage_cache.get(stages["tma"]), stage_cache.get(stages["data"])
    test, train = data.held_out(prefer="test"), data.split("train")
    captioned = has_caption(train).nonzero()[0]
    truths = [truth_of(test, i) for i in sorted(drawn(test, args.clips))]
    others = [
        truth_of(train, int(captioned[i % len(captioned)])) for i in spread_any(train, len(truths) // 2)
    ]
    judge = Captioned(
        tma,
        truths,
        tma.embed_captions([t.caption for t in truths], tma.given["text"].cache),
        embed_motions(tma, [t.features for t in others]),
    )
    sets: list[tuple[list[Joints], Callable[[Sequence[Joints]], Callable[[NDArray[np.int64]], Figures]]]] = [
        ([t.joints for t in truths], lambda motions: judge.figures(motions, args.size))
    ]
    if "audio" in stages:
        dances = Dances(dances_of(test, args.clips), [c.joints for c in dances_of(train, args.clips // 2)])
        sets.append(([clip.joints for clip in dances.clips], dances.figures))
    fps, results = test.layout.fps, {name: {} for name in ("recorded", *FAULTS, SWAPPED)}
    for real, figures in sets:
        rng = np.random.default_rng(0)
        halves = [rng.permutation(len(real))[: len(real) // 2] for _ in range(HALVES)]
        clean = [figures(real)(rows) for rows in halves]
        results["recorded"] |= {name: (float(np.mean([c[name] for c in clean])), "") for name in clean[0]}
        for name in track([*FAULTS, SWAPPED], "judging faults", transient=True):
            if name == SWAPPED:
                made = [real[other] for other in swapped(len(real), rng)]
                made = [_as_long(m, len(r)) for m, r in zip(made, real, strict=True)]
            else:
                made = [FAULTS[name](joints, fps, rng) for joints in real]
            of = figures(made)
            results[name] |= verdicts(clean, [of(rows) for rows in halves])
    show(results, len(truths))
    (args.run / "perturbation.json").write_text(json.dumps(results, indent=1))


def _as_long(joints: Joints, frames: int) -> Joints:
    """Cut, or still at the end."""
    return np.concatenate([joints[:frames], np.repeat(joints[-1:], max(0, frames - len(joints)), axis=0)])


def show(results: dict[str, dict[str, tuple[float, str]]], clips: int) -> None:
    """A row a metric, a column a fault: what fits a page."""
    table = Table(title=f"{clips} captioned clips: + noticed, ! deceived, . neither", title_justify="left")
    for column in ("", *results):
        table.add_column(column, overflow="fold")
    for name in results["recorded"]:
        cells = [results[fault].get(name, (float("nan"), "")) for fault in results]
        table.add_row(name, *(f"{value:.3g} {mark}" for value, mark in cells))
    Console(width=170).print(table)


if __name__ == "__main__":
    main()
