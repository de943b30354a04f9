"""Do generated motions do what their captions say? Measured on the joints of a body-only run.

    python benchmarks/caption_check.py RUN [--samples 20]

For turning captions: the net change of heading. For hand captions: how high each wrist rises above its
shoulder. For walking and running: the distance covered and its speed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from bench import arguments, command_line
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import heading
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.generation import generate
from motionloom.pipeline.inference.request import Request

Joints = NDArray[np.float64]
SKELETON = Skeleton.named("smpl22")


def turned(joints: Joints, fps: float) -> float:
    """Net turn in degrees, left positive."""
    angle = heading(joints, fps)
    return float(np.degrees(angle[-1] - angle[0]))


def raised(joints: Joints, side: str) -> float:
    """Highest the wrist gets above its shoulder, metres."""
    wrist = SKELETON.index(f"{side}_wrist")
    shoulder = SKELETON.index(f"{side}_shoulder")
    return float((joints[:, wrist, 1] - joints[:, shoulder, 1]).max())


def speed(joints: Joints, fps: float) -> float:
    """Mean speed of the root over the ground, metres a second, from start to end of its path."""
    path = np.linalg.norm(np.diff(joints[:, 0][:, [0, 2]], axis=0), axis=1).sum()
    return float(path * fps / len(joints))


def only(joints: Joints, side: str) -> bool:
    """One hand up (no lower than 10 cm under the shoulder), the other hanging."""
    other = "left" if side == "right" else "right"
    return raised(joints, side) > UP and raised(joints, other) < DOWN


UP = -0.1
DOWN = -0.2
Check = Callable[[Joints, float], bool]
BY_CONTENT: dict[str, Check] = {  # by the label of a clip's content
    "walk-turn-left": lambda j, f: turned(j, f) > 45,
    "walk-turn-right": lambda j, f: turned(j, f) < -45,
    "walk": lambda j, f: abs(turned(j, f)) < 45 and 0.3 < speed(j, f) < 2.0,
    "run": lambda j, f: abs(turned(j, f)) < 45 and speed(j, f) > 1.6,
    "raise-up-right-hand": lambda j, f: only(j, "right"),
    "raise-up-left-hand": lambda j, f: only(j, "left"),
    "raise-up-both-hands": lambda j, f: min(raised(j, "left"), raised(j, "right")) > UP,
    "wave-right-hand": lambda j, f: only(j, "right"),
    "wave-left-hand": lambda j, f: only(j, "left"),
    "wave-both-hands": lambda j, f: min(raised(j, "left"), raised(j, "right")) > UP,
}
CAPTIONS = {
    "a person walks and turns left.": "walk-turn-left",
    "a person walks and turns right.": "walk-turn-right",
    "a person walks forward.": "walk",
    "a person runs forward.": "run",
    "a person raises the right hand.": "raise-up-right-hand",
    "a person raises the left hand.": "raise-up-left-hand",
    "a person raises both hands.": "raise-up-both-hands",
    "a person waves the right hand.": "wave-right-hand",
    "a person waves the left hand.": "wave-left-hand",
}


def obeyed(bundle: Bundle, samples: int, sampling: SamplingConfig | None = None) -> dict[str, int]:
    """Return how many of so many motions for each caption do what it says."""
    return {
        caption: sum(
            BY_CONTENT[content](motion.joints, bundle.layout.fps)
            for motion in generate(bundle, Request.of([caption] * samples, seed=0, sampling=sampling))
        )
        for caption, content in CAPTIONS.items()
    }


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--samples", type=int, default=20)
    args = arguments(parser)
    good = obeyed(Bundle.open(args.run), args.samples)
    for caption, count in (good | {"all": sum(good.values())}).items():
        print(f"{caption} {count}/{args.samples * (len(good) if caption == 'all' else 1)}")


if __name__ == "__main__":
    main()
