"""What a clip is going to do, drawn before it is animated: the source of both motion and captions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, TypeVar

import numpy as np

ACTIONS = (
    "walk",
    "turn",
    "run",
    "jump",
    "squat",
    "sit",
    "kick",
    "punch",
    "wave",
    "clap",
    "raise",
    "reach",
    "bow",
    "dance",
)
HANDS = ("relaxed", "fist", "point", "spread", "pinch", "wave_fingers")
FACES = ("neutral", "happy", "sad", "angry", "surprised")
SIDES = ("left", "right")
COUNT_LIMITS = {"jump": 3, "squat": 3, "kick": 2, "punch": 3, "clap": 5}
"""Actions that are counted, and how often at most."""
TEMPI = tuple(range(80, 141, 5))

T = TypeVar("T")
Record = dict[str, Any]
"""Truth of a clip as plain JSON (`ClipMeta.truth`)."""


@dataclass(frozen=True)
class Truth:
    """Attributes of one clip; None where an attribute does not apply."""

    action: str
    direction: str | None = None
    side: str | None = None
    count: int | None = None
    speed: str | None = None
    left_hand: str = "relaxed"
    right_hand: str = "relaxed"
    face: str = "neutral"
    bpm: int | None = None
    style: str | None = None

    def hand(self, side: int) -> str:
        return self.right_hand if side else self.left_hand

    def record(self, *, hands: bool, face: bool) -> Record:
        """Plain JSON form for `ClipMeta.truth`; hand and face entries only where the layout holds them."""
        data = asdict(self)
        if not hands:
            del data["left_hand"], data["right_hand"]
        if not face:
            del data["face"]
        return data


@dataclass(frozen=True)
class Span:
    """Shortest and longest clip, seconds."""

    low: float
    high: float

    def pick(self, rng: np.random.Generator, at_least: float = 0.0, at_most: float = 1e9) -> float:
        """A length within the limits, and within those of the action where they leave room."""
        low = min(max(self.low, at_least), self.high)
        high = max(min(self.high, at_most), low)
        return float(rng.uniform(low, high))


def require_known(names: list[str] | None, known: Sequence[str], what: str) -> list[str] | None:
    """`names` of a config field; `ValueError` for an empty list and for names that are not known."""
    wrong = sorted(set(names or []) - set(known))
    if wrong or names == []:
        raise ValueError(f"no {what} {', '.join(wrong) or 'given'}; known: {', '.join(known)}")
    return names


def draw(action: str, rng: np.random.Generator, hand_shapes: Sequence[str] = HANDS[1:]) -> Truth:
    """Truth of one clip of `action`; hands that are free take one of `hand_shapes` now and then."""
    direction: str | None = None
    side: str | None = None
    speed: str | None = None
    style: str | None = None
    bpm: int | None = None
    count = int(rng.integers(1, COUNT_LIMITS[action] + 1)) if action in COUNT_LIMITS else None
    if action == "walk":
        direction = _one(rng, ("forward", "forward", "backward", "clockwise", "counterclockwise"))
        speed = _one(rng, ("slowly", None, None, "quickly"))
        if direction in ("clockwise", "counterclockwise") and speed == "slowly":
            speed = None
    elif action == "turn":
        direction = _one(rng, SIDES)
        style = _one(rng, ("place", "around", "walking"))
    elif action == "run":
        direction = "forward"
    elif action == "jump":
        direction = _one(rng, ("up", "up", "forward"))
    elif action in ("kick", "punch"):
        side = _one(rng, SIDES)
    elif action in ("wave", "raise"):
        side = _one(rng, (*SIDES, *SIDES, "both"))
        style = _one(rng, ("front", "side")) if action == "raise" else None
    elif action == "reach":
        side = _one(rng, SIDES)
        direction = _one(rng, ("forward", "up", "down", side))
    elif action == "clap":
        count = int(rng.integers(2, COUNT_LIMITS["clap"] + 1))
    elif action == "dance":
        bpm = int(rng.choice(TEMPI))
        style = _one(rng, ("step", "bounce", "sway"))
    if action in ("squat", "bow"):
        speed = _one(rng, ("slowly", None, "quickly"))
    if action == "squat" and count is not None:
        # As many as fit into five seconds without changing the pace.
        count = min(count, {"slowly": 1, None: 2, "quickly": 3}[speed])
    left, right = _hands(action, side, rng, hand_shapes)
    return Truth(action, direction, side, count, speed, left, right, str(rng.choice(FACES)), bpm, style)


def _one(rng: np.random.Generator, options: tuple[T, ...]) -> T:
    return options[int(rng.integers(len(options)))]


def _hands(action: str, side: str | None, rng: np.random.Generator, free: Sequence[str]) -> tuple[str, str]:
    """A shape for each hand; a punch needs a fist, a clap and a wave need open hands."""
    shapes = [str(rng.choice(free)) if rng.random() < 0.4 else "relaxed" for _ in range(2)]
    if rng.random() < 0.12:
        shapes[1] = shapes[0]
    for index, name in enumerate(SIDES):
        busy = side in (name, "both")
        if action == "clap":
            shapes[index] = "relaxed"
        elif action == "punch" and busy:
            shapes[index] = "fist"
        elif action == "wave" and busy:
            shapes[index] = "spread"
    return shapes[0], shapes[1]
