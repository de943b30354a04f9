"""Errors of joints drawn on a figure and on its two hands, as inline SVG; the page's style colours them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import BODY_JOINTS, WRISTS
from motionloom.datasets.motion.skeleton import Skeleton

SIZE, MARGIN, RADIUS = 420, 26, 11.5
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
    places = _places(skeleton)
    body = list(range(1, BODY_JOINTS))  # the root's error is 0 by definition
    out = {"body, from the root": _drawing(errors, skeleton, places, body)}
    fingers = [j for j in range(BODY_JOINTS, len(skeleton)) if skeleton.joints[j] in errors]
    if fingers:
        out["hands, from the wrist"] = _drawing(errors, skeleton, places, fingers)
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
        start = out[parent]
        if joint >= BODY_JOINTS and parent in WRISTS:
            start = (0.11 * np.sign(x), 0.0)
        out[joint] = start + np.array(step)
    return out


def _drawing(
    errors: Mapping[str, float], skeleton: Skeleton, places: NDArray[np.float64], joints: Sequence[int]
) -> str:
    """Limbs and circles of some joints, fitted into the picture, each circle with its error."""
    chosen = places[joints]
    low, high = chosen.min(0), chosen.max(0)
    scale = float(((SIZE - 2 * MARGIN) / (high - low)).min())
    middle = (low + high) / 2
    at = {j: (SIZE / 2 + scale * (x - middle[0]), SIZE / 2 - scale * (y - middle[1]))
          for j, (x, y) in zip(joints, chosen.tolist(), strict=True)}  # fmt: skip
    limbs = "".join(
        f'<line class="limb" x1="{x:.1f}" y1="{y:.1f}" x2="{at[parent][0]:.1f}" y2="{at[parent][1]:.1f}"/>'
        for j, (x, y) in at.items()
        if (parent := skeleton.parents[j]) in at
    )
    values = {j: errors[skeleton.joints[j]] for j in joints if skeleton.joints[j] in errors}
    most = max(values.values(), default=0.0) or 1.0
    circles = "".join(
        f'<g class="joint" style="--share:{100 * value / most:.0f}%">'
        f"<title>{escape(skeleton.joints[j].replace('_', ' '))}: {value:.1f} mm</title>"
        f'<circle cx="{at[j][0]:.1f}" cy="{at[j][1]:.1f}" r="{RADIUS}"/>'
        f'<text x="{at[j][0]:.1f}" y="{at[j][1] + 3.8:.1f}" text-anchor="middle">{value:.0f}</text></g>'
        for j, value in values.items()
    )
    view = f'viewBox="0 0 {SIZE} {SIZE}" role="img" aria-label="Errors of joints in mm"'
    return f'<svg class="chart" {view}>{limbs}{circles}</svg>'
