"""Errors of joints drawn on a figure and on its two hands, as inline SVG; the page's style colours them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import BODY_JOINTS, WRISTS
from motionloom.datasets.motion.skeleton import Skeleton

SIZE = 420
MARGIN = 26
RADIUS = 11.5
_SHOULDER = 16
"""The first joint of the arms in `smplx52`: what follows it hangs from a shoulder."""
_HANGING = (0.5, -0.87)
"""Cosine and sine of the angle by which arms that lie level at rest are drawn lower."""
_DEPTH = 0.45
"""How much lower a point is drawn for each metre that it lies in front, as seen from a little above."""


def body_map(errors: Mapping[str, float], skeleton: Skeleton) -> dict[str, str]:
    """What is drawn -> SVG: the body, and the hands where there are errors of fingers.

    `errors` are mm by joint of a skeleton whose first joints are those of `smplx52`. The figure is seen from
    in front, its right hand on the left; hands are seen on their backs.
    """
    values = {j: errors[name] for j, name in enumerate(skeleton.joints) if j and name in errors}
    body = {j: value for j, value in values.items() if j < BODY_JOINTS}
    fingers = {j: value for j, value in values.items() if j >= BODY_JOINTS}
    places = _places(skeleton)
    out = {"from the root": _drawing(body, skeleton, places, range(BODY_JOINTS))}
    if fingers:
        # Each hand has a place of its own beside the other.
        for wrist, side in zip(WRISTS, (1, -1), strict=True):
            own = [j for j in fingers if np.sign(skeleton.offsets[j, 0]) == side]
            places[[wrist, *own]] += (0.11 * side, 0) - places[wrist]
        out["fingers, from the wrist"] = _drawing(fingers, skeleton, places, [*WRISTS, *fingers])
    return out


def _places(skeleton: Skeleton) -> NDArray[np.float64]:
    """Places [N, 2] of the joints, y upwards, in metres of body or hand."""
    out = np.zeros((len(skeleton), 2))
    cosine, sine = _HANGING
    for joint, (x, y, z) in enumerate(skeleton.offsets.tolist()):
        parent = skeleton.parents[joint]
        if parent < 0:
            continue
        step = (x, y - _DEPTH * z)
        if joint >= BODY_JOINTS:
            # Fingers lie level along x, thumbs in front: here they point up, thumbs outwards.
            step = (np.sign(x) * z, abs(x))
        elif parent >= _SHOULDER:
            step = (x * cosine - np.sign(x) * y * sine, abs(x) * sine + y * cosine)
        out[joint] = out[parent] + step
    return out


def _drawing(
    values: Mapping[int, float], skeleton: Skeleton, places: NDArray[np.float64], joints: Sequence[int]
) -> str:
    """Limbs between some joints, fitted into the picture, and a circle with the error of each with one."""
    chosen = places[list(joints)]
    low = chosen.min(0)
    high = chosen.max(0)
    scale = ((SIZE - 2 * MARGIN) / (high - low)).min()
    wide, tall = scale * (high - low)
    fitted = (chosen - (low[0], high[1])) * (scale, -scale) + ((SIZE - wide) / 2, MARGIN)
    at = dict(zip(joints, fitted.tolist(), strict=True))
    limbs = "".join(
        f'<line class="limb" x1="{x:.1f}" y1="{y:.1f}" x2="{at[parent][0]:.1f}" y2="{at[parent][1]:.1f}"/>'
        for j, (x, y) in at.items()
        if (parent := skeleton.parents[j]) in at
    )
    most = max(values.values(), default=0.0) or 1.0
    circles = "".join(
        f'<g class="joint" style="--p:{100 * value / most:.0f}%">'
        f"<title>{escape(skeleton.joints[j].replace('_', ' '))}: {value:.1f} mm</title>"
        f'<circle cx="{at[j][0]:.1f}" cy="{at[j][1]:.1f}" r="{RADIUS}"/>'
        f'<text x="{at[j][0]:.1f}" y="{at[j][1] + 3.8:.1f}" text-anchor="middle">{value:.0f}</text></g>'
        for j, value in values.items()
    )
    view = f'viewBox="0 0 {SIZE} {tall + 2 * MARGIN:.0f}" role="img" aria-label="Errors of joints in mm"'
    return f'<svg class="chart" {view}>{limbs}{circles}</svg>'
