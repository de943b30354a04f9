"""Is this a person standing on a floor? One clip measured, many clips judged.

A wrong length unit, a wrong upward axis or two rows of a joint map that were swapped give motion that is
finite, smooth and trains without a complaint. What they do not give is people: so the plan of a conversion,
the conversion itself and the check of a data set all measure the same few things here and judge them by the
same bounds (docs/data.md gives each its reason).

Single clips prove nothing, since people lie down, climb and walk backwards: every bound is about a *share* of
the clips.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.canonical import facing, ground
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.skeleton import Skeleton

PERSON_METRES = (1.2, 2.2)
"""Height of a figure: from a child of seven to the tallest people. Wrong units are 2.54 times off or more."""

UPRIGHT = 0.5
"""Cosine between the upward axis and the way from pelvis to head: 60 degrees, which sitting, squatting and
bowing figures stay within for most of a clip."""

FLOOR_METRES = 0.3
"""Largest distance of the lowest joint from the floor in the median frame: jumps are shorter than half a
clip, and joints of feet lie up to 0.1 m above their soles."""

LIMBS = 2.0
"""Factor by which a limb's share of the height may differ from the adult's, and left from right: in any unit,
1.62 was recorded at most. A collapsed skeleton has limbs of hardly any length."""

MOST = 0.5
"""Share of the clips that must be people standing on a floor."""

ODD = 0.2
"""Share of the clips beyond which a few odd ones are worth a warning."""

_RATE = 10.0
"""Frames a second that are looked at."""

_NAMED = Skeleton.named("smpl22")
_PELVIS, _HEAD = _NAMED.index("pelvis"), _NAMED.index("head")
_NECK = _NAMED.index("neck")
_ANKLES = [_NAMED.index(f"{side}_ankle") for side in ("left", "right")]
_FEET = [_NAMED.index(f"{side}_foot") for side in ("left", "right")]
_NEUTRAL_HEIGHT = 1.7
"""Metres: the adult behind the named skeleton (`skeletons/smpl22.json`)."""


_STRETCHES = [
    *((_NAMED.index(f"{side}_hip"), _NAMED.index(f"{side}_knee"), 0.5) for side in ("left", "right")),
    *((_NAMED.index(f"{side}_knee"), _NAMED.index(f"{side}_ankle"), 0.5) for side in ("left", "right")),
    (_PELVIS, _NECK, 1.0),
    (_NECK, _HEAD, 1.0),
]
"""Stretches of a height: (joint, joint, how often it counts). The trunk is one stretch: noise would make its
five short bones longer, and bending hardly makes it shorter."""


def _length(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Joints [..., 22, 3] -> length of a leg, the trunk and the neck [...]."""
    return np.asarray(
        sum(
            weight * np.linalg.norm(joints[..., first, :] - joints[..., second, :], axis=-1)
            for first, second, weight in _STRETCHES
        )
    )


_HEIGHT_OF_LENGTH = _NEUTRAL_HEIGHT / float(_length(_NAMED.rest_joints))
_BONES = [
    [_NAMED.index(f"{side}_{joint}") for side in ("left", "right") for joint in joints]
    for joints in (("hip", "knee", "shoulder", "elbow"), ("knee", "ankle", "elbow", "wrist"))
]
"""Beginnings and ends of thighs, shins, upper arms and forearms, the left ones first."""


def _limbs(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Joints [..., 22, 3] -> length of eight limbs [..., 8]."""
    first, last = _BONES
    return np.asarray(np.linalg.norm(joints[..., last, :] - joints[..., first, :], axis=-1))


@dataclass(frozen=True)
class FigureMeasure:
    """One clip measured. Everything is a median over its frames, so that a bow or a jump does not count."""

    height: float
    """Metres, from the lengths of legs, trunk and neck: nearly the same in any pose."""
    up: tuple[float, float, float]
    """Unit vector from pelvis to head."""
    floor: float
    """Height of the lowest joint of all frames."""
    above_floor: float
    """Height of a frame's lowest joint above `floor`."""
    toes: float
    """Cosine of the feet's direction and the figure's, -1 to 1: negative where left and right are
    swapped."""
    limbs: float = 1.0
    """Largest factor between a limb's share of the height and the adult's, or between left and right."""


def measure(joints: NDArray[np.floating], fps: float) -> FigureMeasure:
    """Measure a clip of joints [T, N, 3], Y up, the first 22 those of the body skeleton."""
    step = max(1, round(fps / _RATE))
    body = np.asarray(joints[::step, :BODY_JOINTS], dtype=np.float64)
    trunk = body[:, _HEAD] - body[:, _PELVIS]
    up = np.median(trunk / np.maximum(np.linalg.norm(trunk, axis=-1, keepdims=True), 1e-9), axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-9)
    # The floor is the lowest joint of all frames, also of those that are not measured: jumps begin on it.
    lowest = body[..., 1].min(axis=-1)
    floor = float(np.asarray(joints)[:, :BODY_JOINTS, 1].min())
    heading = np.exp(1j * facing(body))
    toes = ground(body[:, _FEET] - body[:, _ANKLES]) * heading.conj()[:, None]
    height = float(np.median(_length(body))) * _HEIGHT_OF_LENGTH
    limbs = np.maximum(np.median(_limbs(body), axis=0), 1e-9)
    shares = limbs / max(height, 1e-9) * (_NEUTRAL_HEIGHT / _limbs(_NAMED.rest_joints))
    factors = np.concatenate([shares, limbs[:4] / limbs[4:]])
    return FigureMeasure(
        height=height,
        up=(float(up[0]), float(up[1]), float(up[2])),
        floor=floor,
        above_floor=float(np.median(lowest)) - floor,
        toes=float(np.median(toes.real / np.maximum(np.abs(toes), 1e-9))),
        limbs=float(np.maximum(factors, 1 / factors).max()),
    )


Kind = Literal["size", "limbs", "lying", "upside down", "floating", "below the floor", "left and right"]


@dataclass(frozen=True)
class Oddity:
    """A fault that many clips have in common and people standing on a floor have not."""

    kind: Kind
    clips: int
    of: int
    """Clips that were measured for it."""
    text: str
    """One sentence."""

    @property
    def share(self) -> float:
        """Share of the measured clips."""
        return self.clips / self.of

    @property
    def is_error(self) -> bool:
        """Whether it is so in most clips."""
        return self.share > MOST


class PlausibilityStats:
    """Many clips together, in 24 bytes each."""

    def __init__(self) -> None:
        self._rows = array("f")

    def __len__(self) -> int:
        return len(self._rows) // 6

    def add(self, clip: FigureMeasure) -> None:
        self._rows.extend((clip.height, clip.up[1], clip.floor, clip.above_floor, clip.toes, clip.limbs))

    def _columns(self) -> list[NDArray[np.float64]]:
        """Height, upward part, floor, distance from it, toes and limbs of the clips, each [n]."""
        return list(np.array(self._rows, dtype=np.float64).reshape(-1, 6).T)

    @property
    def height(self) -> float:
        """Median height of the figures in metres; NaN without any."""
        return float(np.median(self._columns()[0])) if len(self) else float("nan")

    @property
    def upright(self) -> float:
        """Share of the clips whose head is above the pelvis; NaN without any."""
        return float(np.mean(self._columns()[1] > UPRIGHT)) if len(self) else float("nan")

    @property
    def above_floor(self) -> float:
        """Median distance of a figure from the floor of its clip, metres; NaN without any."""
        return float(np.median(self._columns()[3])) if len(self) else float("nan")

    def oddities(self, *, floor_at_zero: bool = False) -> list[Oddity]:
        """Return faults of more than a few clips, the worst first; `floor_at_zero`: for canonical motion."""
        if not len(self):
            return []
        height, up, floor, above, toes, limbs = self._columns()
        small, tall = PERSON_METRES
        out: list[Oddity] = []

        def count(kind: Kind, odd: NDArray[np.bool_], text: str, of: int | None = None) -> None:
            number = int(odd.sum())
            total = of or len(self)
            if number > ODD * total:
                share = f"{number} of {total} clips ({number / total:.0%})"
                out.append(Oddity(kind, number, total, f"{share} {text}"))

        # Written so that NaN counts as odd: a comparison with NaN is false.
        count(
            "size",
            ~((height >= small) & (height <= tall)),
            f"show figures that are not {small:g} to {tall:g} m tall (median {self.height:.3g} m; "
            f"a wrong length unit?)",
        )
        count(
            "limbs",
            ~(limbs <= LIMBS),
            f"show figures with a limb {LIMBS:g} times longer or shorter than a person's, or its other side "
            f"(joints in wrong places, or a collapsed skeleton?)",
        )
        count(
            "upside down", up < -UPRIGHT, "show figures whose head is below the pelvis (a wrong upward axis?)"
        )
        count(
            "lying",
            np.abs(up) <= UPRIGHT,
            "show figures whose head is not above the pelvis (they lie: a wrong upward axis?)",
        )
        upright = up > UPRIGHT
        standing = int(upright.sum())
        if standing:  # the others have no floor and face nowhere
            floor = floor if floor_at_zero else np.zeros(len(self))
            low = floor < -FLOOR_METRES
            count(
                "floating",
                upright & ~low & ~(above + floor <= FLOOR_METRES),
                f"show figures that float more than {FLOOR_METRES:g} m above the floor",
                standing,
            )
            count(
                "below the floor",
                upright & low,
                f"show figures more than {FLOOR_METRES:g} m below the floor",
                standing,
            )
            count(
                "left and right",
                upright & (toes < 0),
                "show feet that point backwards (left and right swapped?)",
                standing,
            )
        return sorted(out, key=lambda oddity: not oddity.is_error)
