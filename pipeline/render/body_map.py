"""Errors of joints drawn on a body seen from the front, and on both hands, as inline SVG.

The figure is the skeleton's rest pose with the arms let down, so that it fits a phone held upright. Hands are
drawn larger, on a scale of their own: what is measured from the wrist is smaller by far than what is measured
from the root. Each joint shows its error as a number besides its colour.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.layout import BODY_JOINTS, WRISTS
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.pipeline.render.labels import joint_label

STOPS = ((254, 240, 190), (253, 190, 90), (238, 110, 60), (190, 45, 60), (95, 15, 70))
"""From no error to the largest; dark enough at the end and light enough at the start on either theme."""
ARMS_DOWN = math.radians(63)
_ARMS = ((16, 18, 20), (17, 19, 21))
_LABELLED = (15, 18, 19, 20, 21, 4, 5, 10, 11)
"""Joints of the body that have their name beside them."""
_WIDTH, _BODY_HEIGHT, _HAND_HEIGHT = 400, 580, 320


@dataclass(frozen=True)
class Scale:
    """Colours of errors from 0 to `top` mm."""

    top: float

    @staticmethod
    def for_errors(errors: Sequence[float]) -> Scale:
        """Up to a round number at or above the largest error."""
        largest = max((e for e in errors if math.isfinite(e)), default=0.0)
        power = 10.0 ** math.floor(math.log10(largest)) if largest > 0 else 1.0
        return Scale(next((m * power for m in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if m * power >= largest), 1.0))

    def colour(self, error: float) -> str:
        """`#rrggbb` of an error in mm."""
        place = min(max(error / self.top, 0.0), 1.0) * (len(STOPS) - 1)
        low = min(int(place), len(STOPS) - 2)
        mixed = [a + (b - a) * (place - low) for a, b in zip(STOPS[low], STOPS[low + 1], strict=True)]
        return "#" + "".join(f"{round(value):02x}" for value in mixed)

    def ink(self, error: float) -> str:
        """What can be read on that colour."""
        return "#1d2330" if error < 0.45 * self.top else "#ffffff"


def body_map(
    skeleton: Skeleton, errors: Sequence[float], hands: Sequence[float] = (), title: str = ""
) -> str:
    """Two drawings side by side where there is room: the body, and the hands where there are any.

    Args:
        skeleton: `smpl22` or `smplx52`.
        errors: mm of each joint of the skeleton, [N]; those of the body are drawn.
        hands: mm of the finger joints from their wrists, [30], left hand first.
        title: What is shown, for those who hear the page.
    """
    if len(errors) != len(skeleton) or len(skeleton) < BODY_JOINTS:
        raise UserError(f"{len(errors)} errors for the {len(skeleton)} joints of {skeleton.name}")
    if len(hands) not in (0, len(skeleton) - BODY_JOINTS):
        raise UserError(f"{len(hands)} errors of fingers for {len(skeleton) - BODY_JOINTS} joints")
    parts = [_body(skeleton, errors[:BODY_JOINTS], title)]
    if len(hands):
        parts.append(_hands(skeleton, hands, title))
    return f'<div class="maps">{"".join(parts)}</div>'


def _body(skeleton: Skeleton, errors: Sequence[float], title: str) -> str:
    scale = Scale.for_errors(errors)
    points = _standing(skeleton)[:BODY_JOINTS]
    low, high = points.min(0), points.max(0)
    size = min((_WIDTH - 150) / (high[0] - low[0]), (_BODY_HEIGHT - 150) / (high[1] - low[1]))
    centre = (low[0] + high[0]) / 2
    at = [(_WIDTH / 2 + (x - centre) * size, 76 + (high[1] - y) * size) for x, y in points.tolist()]
    out = [
        _bone(at[parent], at[joint], 20 if joint in (1, 2, 3, 6, 9, 13, 14) else 15)
        for joint, parent in enumerate(skeleton.parents[:BODY_JOINTS])
        if parent >= 0
    ]
    head = at[15]
    out.append(f'<ellipse class="limb" cx="{head[0]:.1f}" cy="{head[1] - 8:.1f}" rx="27" ry="35"/>')
    out += [_joint(skeleton.joints[k], at[k], error, scale, 9.8) for k, error in enumerate(errors)]
    for k in _LABELLED:
        out.append(_side_label(skeleton.joints[k], at[k]))
    out.append(_text(8, 18, "seen from the front: its right hand is on your left", "start", "note"))
    out.append(_legend(scale, _BODY_HEIGHT - 44, "mm, root of each frame at one place"))
    return _svg(_BODY_HEIGHT, f"{title}: the body", out)


def _hands(skeleton: Skeleton, errors: Sequence[float], title: str) -> str:
    scale, count = Scale.for_errors(errors), len(errors) // 2
    rest, out = skeleton.rest_joints, []
    for hand, wrist in enumerate(WRISTS):
        first = BODY_JOINTS + hand * count
        offsets = rest[first : first + count] - rest[wrist]
        # The back of the hand, fingers up: a left thumb is on the right.
        sign = 1.0 if hand == 0 else -1.0
        flat = np.stack([sign * offsets[:, 2] * 1200, -np.abs(offsets[:, 0]) * 1120], -1)
        origin = np.array([_WIDTH * (0.735 if hand == 0 else 0.265), _HAND_HEIGHT - 78])
        at = [tuple(row) for row in (flat + origin).tolist()]
        place = (float(origin[0]), float(origin[1]))
        for k in range(count):
            parent = skeleton.parents[first + k]
            out.append(_bone(place if parent == wrist else at[parent - first], at[k], 13))
        out.append(f'<circle class="limb" cx="{place[0]:.1f}" cy="{place[1]:.1f}" r="10"/>')
        for k in range(count):
            out.append(_joint(skeleton.joints[first + k], at[k], errors[hand * count + k], scale, 9.8))
        side = "left hand" if hand == 0 else "right hand"
        out.append(_text(place[0], place[1] + 26, side, "middle", "name"))
    out.append(_text(8, 18, "backs of the hands; errors from the wrist", "start", "note"))
    out.append(_legend(scale, _HAND_HEIGHT - 40, "mm, each wrist at one place"))
    return _svg(_HAND_HEIGHT, f"{title}: the hands", out)


def _standing(skeleton: Skeleton) -> NDArray[np.float64]:
    """Front view [N, 2] of the rest pose with the arms let down; the figure's left is at larger x."""
    rest = skeleton.rest_joints
    points = rest[:, :2].copy()
    points[:, 1] -= 0.35 * rest[:, 2]  # from a little above, or toes would hide the ankles
    for side, arm in enumerate(_ARMS):
        turn = -ARMS_DOWN if side == 0 else ARMS_DOWN
        cos, sin = math.cos(turn), math.sin(turn)
        shoulder = points[arm[0]].copy()
        for joint in arm[1:]:
            x, y = points[joint] - shoulder
            points[joint] = shoulder + np.array([cos * x - sin * y, sin * x + cos * y])
    return points


def _bone(a: tuple[float, ...], b: tuple[float, ...], width: float) -> str:
    return (
        f'<line class="limb" x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}" '
        f'stroke-width="{width:g}"/>'
    )


def _joint(name: str, at: tuple[float, ...], error: float, scale: Scale, radius: float) -> str:
    number = f"{error:.0f}" if error >= 9.95 else f"{error:.1f}"
    tip = escape(f"{joint_label(name)}: {error:.1f} mm")
    size = ";font-size:8px" if error >= 99.5 else ""
    return (
        f'<g><title>{tip}</title><circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{radius:g}" '
        f'fill="{scale.colour(error)}" stroke="#5b6475" stroke-width="0.7"/>'
        f'<text class="value" x="{at[0]:.1f}" y="{at[1] + 3.4:.1f}" style="fill:{scale.ink(error)}{size}">'
        f"{number}</text></g>"
    )


def _side_label(name: str, at: tuple[float, ...]) -> str:
    """The name beside a joint, on the outside of the figure; a hand's at its wrist."""
    words = joint_label(name).replace("ball of the foot", "foot").replace("wrist", "hand")
    left = at[0] >= _WIDTH / 2
    return _text(at[0] + (18 if left else -18), at[1] + 4, words, "start" if left else "end", "name")


def _legend(scale: Scale, top: float, unit: str) -> str:
    wide = _WIDTH - 40
    stops = "".join(
        f'<rect x="{20 + wide * k / 40:.1f}" y="{top:g}" width="{wide / 40 + 0.4:.1f}" height="10" '
        f'fill="{scale.colour(scale.top * (k + 0.5) / 40)}"/>'
        for k in range(40)
    )
    ends = _text(20, top + 25, "0", "start") + _text(20 + wide, top + 25, f"{scale.top:g} mm", "end")
    return stops + ends + _text(_WIDTH / 2, top + 25, unit, "middle")


def _text(x: float, y: float, text: str, anchor: str, kind: str = "") -> str:
    named = f' class="{kind}"' if kind else ""
    return f'<text{named} x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _svg(height: float, label: str, parts: Sequence[str]) -> str:
    return (
        f'<svg class="map" viewBox="0 0 {_WIDTH} {height:g}" role="img" '
        f'aria-label="{escape(label, quote=True)}">{"".join(parts)}</svg>'
    )
