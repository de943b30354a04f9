"""`EditTask`: the description of an edit, for the command line, Python and the page's JSON.

Times are seconds of the clip: 0 is its first frame, and frames made before it (`lead`) have negative times.
Positions are metres in the clip's world, Y up, the floor at height 0.

The model makes everything that is neither kept nor constrained.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Self

from pydantic import Field, model_validator

from motionloom.datasets.base.config import Config
from motionloom.datasets.motion.layout import FigurePart

MAX_SPEED = 12.0
"""Metres a second of a root; the fastest sprint that was measured (Bolt, Berlin 2009) reached 12.4."""
Seconds = Annotated[float, Field(ge=-3600, le=3600)]
Length = Annotated[float, Field(ge=0, le=3600)]
"""Seconds, not negative. A bound put on `Seconds` would be lost: the last of two lower ones counts."""
Metres = Annotated[float, Field(ge=-1000, le=1000)]


class Kept(Config):
    """The parts that stay as they are in the clip, from `start` up to `end`."""

    start: Length = 0.0
    end: Seconds | None = None
    """None: to the clip's end."""
    parts: tuple[FigurePart, ...] = ("all",)
    but: tuple[FigurePart, ...] = ()
    """Parts that are not kept after all: `parts: [all], but: [right_hand]` makes the right hand anew."""

    @model_validator(mode="after")
    def _forward(self) -> Self:
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"it ends at {self.end:g} s, before it starts ({self.start:g} s)")
        if not self.parts:
            raise ValueError("it names no parts; leave `parts` out for all of them")
        return self


class PathPoint(Config):
    """Position of the root on the floor at one time."""

    at: Seconds
    x: Metres
    z: Metres


class Pin(Config):
    """Position of a joint at one time. A pose is several pins of one time."""

    at: Seconds
    joint: str
    """A name of the layout's skeleton, such as left_wrist."""
    position: tuple[Metres, Metres, Metres]


class EditTask(Config):
    """An edit: the parts of a clip to keep, and the constraints on the rest."""

    caption: str = ""
    """Describes the new motion; empty: any that fits."""
    lead: Length = 0.0
    """Seconds to make before the clip."""
    seconds: Length | None = Field(None, gt=0)
    """Length of the result from the clip's first frame on; None: the clip's. Longer: made after its end."""
    mirror: bool = False
    """Swap left and right of the clip."""
    speed: float = Field(1.0, ge=0.1, le=10)
    """Factor of the clip's speed."""
    repeat: int = Field(1, ge=1, le=20)
    """Number of times that the clip is played, each time from where it ended."""
    keep: tuple[Kept, ...] | None = None
    """None: all of the clip if the result is longer or the clip is changed, else nothing."""
    path: tuple[PathPoint, ...] = ()
    """Points of the root's path, joined by a smooth curve that does not overshoot."""
    backward: bool = False
    """Walk the path backward, facing away from where it goes."""
    pins: tuple[Pin, ...] = ()

    @property
    def changes_clip(self) -> bool:
        """Whether the clip is mirrored, retimed or repeated, which comes first and needs no model."""
        return self.mirror or self.speed != 1 or self.repeat > 1

    @model_validator(mode="after")
    def _possible(self) -> Self:
        for one, two in pairwise(self.path):
            if two.at <= one.at:
                raise ValueError(f"path: {two.at:g} s comes after {one.at:g} s; give them in order of time")
        return self


@dataclass(frozen=True)
class EditReport:
    """Errors of a motion against its task; centimetres, and m/s²."""

    kept_cm: float
    """Largest displacement of a kept joint: in the world where the legs are kept, else in the figure's frame.
    NaN where none is kept."""
    path_cm: float
    """Largest distance of the root from its path; NaN without one."""
    pins_cm: dict[str, float]
    """Distance of each pinned joint from its place, by joint and seconds."""
    aside_degrees: float
    """Mean angle between where the figure faces and where it walks on its path; NaN without one."""
    seams: float
    """Largest acceleration (mean over joints) where kept and made frames meet; NaN where they do not."""
    inside: float
    """Largest acceleration of the clip itself."""
    sliding: float
    """Mean speed of the slower foot where the legs are made, cm/s; NaN where they are kept."""
    clip_sliding: float
    """Sliding of the clip."""

    def lines(self) -> list[str]:
        """Return the report for people, one line for each figure that applies."""
        facing = f"faces {self.aside_degrees:.0f} degrees away from where it walks"
        seams = f"largest acceleration at a seam: {self.seams:.1f} m/s², in the clip {self.inside:.1f} m/s²"
        sliding = f"slower foot: {self.sliding:.1f} cm/s, in the clip {self.clip_sliding:.1f} cm/s"
        lines = {
            f"kept joints: {self.kept_cm:.2f} cm at most from the clip": self.kept_cm,
            f"path: {self.path_cm:.1f} cm at most off it, {facing}": self.path_cm,
            **{f"pin {name}: {miss:.1f} cm off": miss for name, miss in self.pins_cm.items()},
            seams: self.seams,
            sliding: self.sliding,
        }
        return [line for line, value in lines.items() if not math.isnan(value)]
