"""`EditTask`: what is to be done to a clip; one config for the command line, Python and the page's JSON.

Times are seconds of the clip: 0 is its first frame, what is made before it (`lead`) has negative ones.
Positions are metres in the clip's world, Y up, the floor at height 0.

What is neither kept nor constrained is free: the model makes it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from motionloom.datasets.schema import Config

EditPart = Literal[
    "all", "upper", "lower", "left_arm", "right_arm", "left_hand", "right_hand", "hands", "face"
]
"""Groups of a figure's columns. `lower` are pelvis and legs, and with them where the figure goes; `upper` is
all above the pelvis but the face; arms are without fingers; hands are the fingers."""

FASTEST = 12.0
"""Metres a second; nobody runs faster."""
CEILING = 3.0
"""Metres; no joint of a standing or jumping person comes higher."""

Seconds = Annotated[float, Field(allow_inf_nan=False)]
Metres = Annotated[float, Field(allow_inf_nan=False, ge=-1000, le=1000)]


class Kept(Config):
    """What stays as it is in the clip, from `start` up to `end`."""

    start: Seconds = Field(0.0, ge=0)
    end: Seconds | None = None
    """None: to the clip's end."""
    parts: tuple[EditPart, ...] = Field(("all",), min_length=1)
    but: tuple[EditPart, ...] = ()
    """What of these is free after all: `parts: [all], but: [right_hand]` makes the right hand anew."""

    @model_validator(mode="after")
    def _forward(self) -> Self:
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"it ends at {self.end:g} s, before it starts ({self.start:g} s)")
        return self


class PathPoint(Config):
    """Where the root is on the floor at one time."""

    at: Seconds
    x: Metres
    z: Metres


class Pin(Config):
    """Where a joint is at one time. A pose is several pins of one time."""

    at: Seconds
    joint: str
    """A name of the layout's skeleton, such as left_wrist."""
    position: tuple[Metres, Metres, Metres]

    @model_validator(mode="after")
    def _within_reach(self) -> Self:
        height = self.position[1]
        if not -0.5 <= height <= CEILING:
            raise ValueError(
                f"{self.joint} is pinned {height:g} m above the floor; nobody reaches that, "
                f"take -0.5 to {CEILING:g} m"
            )
        return self


class Words(Config):
    """What the person does from `start` to `end`, in place of the caption."""

    start: Seconds
    end: Seconds
    text: str

    @model_validator(mode="after")
    def _says_something(self) -> Self:
        if self.end <= self.start:
            raise ValueError(f"they end at {self.end:g} s, before they start ({self.start:g} s)")
        if not self.text.strip():
            raise ValueError("text is empty; say what the person does")
        return self


class EditTask(Config):
    """What to keep of a clip, and what the rest must do."""

    caption: str = ""
    """What the person does where no `words` say otherwise; empty: whatever fits."""
    face: str = ""
    """What the face does; empty takes the caption."""
    lead: Seconds = Field(0.0, ge=0)
    """Seconds to make before the clip."""
    seconds: Seconds | None = Field(None, gt=0)
    """Length of the result from the clip's first frame on; None: the clip's. Longer: made after its end."""
    keep: tuple[Kept, ...] = ()
    """None: with `words`, all outside of them, and all of the clip where the result is longer than it;
    else nothing."""
    path: tuple[PathPoint, ...] = ()
    """Between its points the root takes the straight line at an even speed."""
    pins: tuple[Pin, ...] = ()
    words: tuple[Words, ...] = ()
    strength: float = Field(1.0, ge=0, le=100, allow_inf_nan=False)
    """How hard each denoising step is pulled towards path and pins. More is nearer and less natural; 0 leaves
    them to `exact` alone."""
    exact: bool = True
    """Meet path and pins at the end by moving the motion around them as little as needed."""
    likeness: float = Field(0.0, ge=0, lt=1)
    """How much of the clip is left in what is free: 0 is made anew, towards 1 it stays near the clip."""

    @model_validator(mode="after")
    def _possible(self) -> Self:
        _in_order("path", [point.at for point in self.path])
        for one, two in pairwise(self.path):
            speed = math.hypot(two.x - one.x, two.z - one.z) / (two.at - one.at)
            if speed > FASTEST:
                raise ValueError(
                    f"path: {speed:.0f} m/s between {one.at:g} s and {two.at:g} s; nobody runs faster than "
                    f"{FASTEST:g} m/s, give the points more time"
                )
        _in_order("words", [said.start for said in self.words])
        for first, second in pairwise(self.words):
            if second.start < first.end:
                raise ValueError(f"words: two stretches overlap at {second.start:g} s")
        places = [(pin.at, pin.joint) for pin in self.pins]
        for place in places:
            if places.count(place) > 1:
                raise ValueError(f"pins: {place[1]} is pinned twice at {place[0]:g} s")
        return self


def _in_order(name: str, times: Sequence[float]) -> None:
    for one, two in pairwise(times):
        if two <= one:
            raise ValueError(f"{name}: {two:g} s comes after {one:g} s; give them in order of time")
