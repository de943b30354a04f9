"""The truth of a clip, drawn before it is animated: the source of both motion and captions."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from typing import TypeVar

import numpy as np

from motionloom.datasets.actions.dances import Record
from motionloom.datasets.actions.hands import HANDS, SIDES
from motionloom.datasets.motion.body.expressions import FACES

TEMPI = tuple(range(80, 141, 5))

T = TypeVar("T")


@dataclass(frozen=True)
class Action:
    """Values that clips of one action draw from; None leaves an attribute unstated."""

    side: tuple[str, ...] = ()
    direction: tuple[str, ...] = ()
    speed: tuple[str | None, ...] = ()
    style: tuple[str, ...] = ()
    most: int = 0
    """Largest count; 0 where the action is not counted."""
    hand: str | None = None
    """Shape of the hands that take part, which captions need not state."""
    chains: tuple[str, ...] | None = None
    """Directions as one of two actions in turn, for those that can begin and end standing."""


OWN = "own"
"""The direction that is the side's."""
_PACES = ("slowly", None, "quickly")
ACTIONS = {
    "walk": Action(
        direction=("forward", "forward", "backward", "clockwise", "counterclockwise"),
        speed=("slowly", None, None, "quickly"),
        chains=("forward", "backward"),
    ),
    "turn": Action(direction=SIDES, style=("place", "around", "walking"), chains=SIDES),
    "run": Action(direction=("forward", "forward", "clockwise", "counterclockwise")),
    "jump": Action(direction=("up", "up", "forward"), most=4, chains=("up", "forward")),
    "squat": Action(speed=_PACES, most=3, chains=()),
    "sit": Action(chains=()),
    "kick": Action(side=SIDES, most=2, chains=()),
    "punch": Action(side=SIDES, most=3, hand="fist", chains=()),
    "wave": Action(side=(*SIDES, *SIDES, "both"), hand="spread", chains=()),
    "clap": Action(most=5, hand="relaxed", chains=()),
    "raise": Action(side=(*SIDES, *SIDES, "both"), style=("front", "side"), chains=()),
    "reach": Action(side=SIDES, direction=("forward", "up", "down", OWN)),
    "bow": Action(speed=_PACES, chains=()),
    "dance": Action(style=("step", "bounce", "sway")),
    "point": Action(
        side=SIDES, direction=("forward", "up", OWN), hand="point", chains=("forward", "up", OWN)
    ),
    "hop": Action(side=SIDES, most=4, chains=()),
    "lie": Action(),
    "crawl": Action(direction=("forward",), hand="relaxed"),
    "stretch": Action(direction=("up", *SIDES), chains=("up", *SIDES)),
    "then": Action(hand="relaxed"),
}
SEATED = ("punch", "wave", "clap", "raise", "point")
"""Actions of the arms, which somebody who sat down before does without getting up."""
BASIC = tuple(ACTIONS)[:14]
"""The actions of a config that asks for none; the others are for models that shall know more."""


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
    parts: tuple[Truth, Truth] | None = None
    """The two actions in turn of a "then"."""

    def hand(self, side: int) -> str:
        return self.right_hand if side else self.left_hand

    def record(self, *, hands: bool, face: bool) -> Record:
        """Plain JSON form for `ClipMeta.truth`; hand and face entries only where the layout holds them."""
        data = asdict(self)
        if self.parts is None:
            del data["parts"]
        else:
            data["parts"] = [
                {name: v for name, v in asdict(part).items() if v is not None} for part in self.parts
            ]
            for part in data["parts"]:
                del part["left_hand"], part["right_hand"], part["face"]
        if not hands or self.parts:  # hands change from part to part
            del data["left_hand"], data["right_hand"]
        if not face:
            del data["face"]
        return data


@dataclass(frozen=True)
class Span:
    """Shortest and longest clip, seconds."""

    low: float
    high: float
    returns: bool = False
    """Whether the clip has to begin and end with somebody who stands, arms down."""

    def pick(self, rng: np.random.Generator, at_least: float = 0.0, at_most: float = 1e9) -> float:
        """A length within the limits, and within those of the action where they leave room."""
        low = min(max(self.low, at_least), self.high)
        high = max(min(self.high, at_most), low)
        return float(rng.uniform(low, high))


def require_known(names: list[str] | None, known: Collection[str], what: str) -> list[str] | None:
    """`names` of a config field; `ValueError` for an empty list and for names that are not known."""
    wrong = sorted(set(names or []) - set(known))
    if wrong or names == []:
        raise ValueError(f"no {what} {', '.join(wrong) or 'given'}; known: {', '.join(known)}")
    return names


def draw(action: str, rng: np.random.Generator, hand_shapes: Sequence[str] = HANDS[1:]) -> Truth:
    """Truth of one clip of `action`; hands that are free take one of `hand_shapes` now and then."""
    kind = ACTIONS[action]
    count = int(rng.integers(1, kind.most + 1)) if kind.most else None
    side = _one(rng, kind.side)
    direction = _one(rng, tuple(str(side) if way == OWN else way for way in kind.direction))
    speed = _one(rng, kind.speed)
    if direction in ("clockwise", "counterclockwise") and speed == "slowly":
        speed = None
    bpm = int(rng.choice(TEMPI)) if action == "dance" else None
    style = _one(rng, kind.style)
    if action == "clap":
        count = int(rng.integers(2, kind.most + 1))
    if action == "squat" and count is not None:
        # As many as fit into five seconds without changing the pace.
        count = min(count, {"slowly": 1, None: 2, "quickly": 3}[speed])
    parts = _chain(rng) if action == "then" else None
    left, right = _hands(action, side, rng, hand_shapes)
    face = str(rng.choice(FACES))
    return Truth(action, direction, side, count, speed, left, right, face, bpm, style, parts)


def _chain(rng: np.random.Generator) -> tuple[Truth, Truth]:
    """Two different actions, each once and at its usual pace; between them one stands or sits."""
    able = [name for name, kind in ACTIONS.items() if kind.chains is not None]
    first, second = (_link(able[int(k)], rng) for k in rng.permutation(len(able))[:2])
    return first, second


def _link(action: str, rng: np.random.Generator) -> Truth:
    kind = ACTIONS[action]
    side = _one(rng, kind.side)
    direction = _one(rng, tuple(str(side) if way == OWN else way for way in kind.chains or ()))
    style = _one(rng, tuple(style for style in kind.style if style != "walking"))
    left, right = _hands(action, side, rng, ("relaxed",))
    return Truth(action, direction, side, left_hand=left, right_hand=right, style=style)


def _one(rng: np.random.Generator, options: Sequence[T]) -> T | None:
    """One of the options; None of none, and the only one without a draw."""
    if len(options) < 2:
        return options[0] if options else None
    return options[int(rng.integers(len(options)))]


def _hands(action: str, side: str | None, rng: np.random.Generator, free: Sequence[str]) -> tuple[str, str]:
    """A shape for each hand; some actions need a fist, an open or a pointing hand."""
    shapes = [str(rng.choice(free)) if rng.random() < 0.4 else "relaxed" for _ in range(2)]
    if rng.random() < 0.12:
        shapes[1] = shapes[0]
    for index, name in enumerate(SIDES):
        if takes_part(action, side, name):
            shapes[index] = ACTIONS[action].hand or shapes[index]
    return shapes[0], shapes[1]


def takes_part(action: str, side: str | None, hand: str) -> bool:
    """Whether an action with `side` gives the left or right `hand` its shape."""
    return ACTIONS[action].hand is not None and side in (hand, "both", None)
