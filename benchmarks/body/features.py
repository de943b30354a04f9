"""The face: eyes, brows and mouth laid on the head, and the expressions as displacements of its vertices.

An expression is what the five controls of the face make of it (`pipeline/render/body/face.py`).
Each becomes one morph target, and targets add up: sadness and a blink are the sum of both. Talking (columns
5 to 7 of the synthetic basis, to which its source gives no shape) opens, widens and purses the mouth
**[ours]**.

The mouth is a fine patch of skin with lips, and behind them teeth and a dark hollow; the head's own skin is
dented there. One displacement, `skin_shift`, moves all of it together with the skin around.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from field import Field
from numpy.typing import NDArray

from motionloom.pipeline.render.body.face import ARKIT

Floats = NDArray[np.float64]
Triangles = NDArray[np.int64]


@dataclass(frozen=True)
class Look:
    """Controls of a face; these are neutral."""

    smile: float = 0.0
    brow: float = 0.0
    eye_open: float = 1.0
    mouth_open: float = 0.0
    frown: float = 0.0
    purse: float = 0.0


EXPRESSIONS: dict[str, Look] = {
    "happy": Look(smile=1.0, eye_open=0.75, mouth_open=0.25),
    "sad": Look(brow=0.35, eye_open=0.7, frown=1.0),
    "angry": Look(brow=-0.9, eye_open=0.8, frown=0.6),
    "surprised": Look(brow=1.0, eye_open=1.6, mouth_open=0.9),
    "blink": Look(eye_open=0.0),
    "talk_open": Look(mouth_open=0.35),
    "talk_wide": Look(smile=0.25, mouth_open=0.1),
    "talk_purse": Look(purse=1.0, mouth_open=0.1),
}
"""The look of each column of the synthetic basis at its apex, in the basis' order."""

_WIDE_EYE = 1.6
CONTROLS: dict[str, Look] = {
    "smile": Look(smile=1.0),
    "frown": Look(frown=1.0),
    "brow_up": Look(brow=1.0),
    "brow_down": Look(brow=-1.0),
    "eye_wide": Look(eye_open=_WIDE_EYE),
    "eye_shut": Look(eye_open=0.0),
    "mouth_open": Look(mouth_open=1.0),
}
"""One look for each end of the drawn face's controls: what the page moves the face by."""

_EYE_WIDTH = 0.0165
_EYE_HEIGHT = 0.0108
_EYE_X = 0.0325
_EYE_Y = 0.006
_RING = 24
_MOUTH_Y = -0.055
_MOUTH_WIDTH = 0.025
_JAW_DROP = 0.022
PATCH = (0.044, 0.03)
"""Half width and half height of the skin around the mouth."""


@dataclass(frozen=True)
class Feature:
    """A patch on the face: vertices as a function of the look, in face coordinates."""

    swatch: str
    triangles: Triangles
    outline: Callable[[Look], Floats]
    """[V, 3]: left, up, lift off the skin; metres from the middle of the head."""
    jaw: Floats | None = None
    """Share of the jaw's way that a vertex goes [V]; None for what moves as the skin under it."""
    round: bool = False
    """Has its own normals, not those of the skin."""


def features() -> list[Feature]:
    """Eyes, pupils, brows and the mouth."""
    out = []
    for sign in (-1.0, 1.0):
        out.append(Feature("white", _fan(_RING), _eye(sign, _EYE_WIDTH, _EYE_HEIGHT, 0.0012)))
        out.append(Feature("dark", _fan(_RING), _eye(sign, 0.0078, 0.0084, 0.002)))
        out.append(Feature("dark", _ribbon(_RING), _lid(sign)))
        out.append(Feature("brow", _ribbon(8), _brow(sign)))
    return out + _mouth()


def behind_mouth(local: Floats, triangles: Triangles) -> NDArray[np.bool_]:
    """Which vertices [V, 3] of the head's own skin have only neighbours under the patch around the mouth."""
    x, y, z = local.T
    under = ((x / PATCH[0]) ** 2 + ((y - _MOUTH_Y) / PATCH[1]) ** 2 < 1) & (z > 0.03)
    out = np.ones(len(local), dtype=bool)
    out[triangles[~under[triangles].all(axis=1)]] = False
    return out


def on_skin(skin: Field, centre: Floats, places: Floats) -> Floats:
    """World points [V, 3] of face coordinates [V, 3]: straight back onto the skin, then lifted off it."""
    point = centre + np.column_stack([places[:, :2], np.full(len(places), 0.16)])
    front = point[:, 2].copy()
    back = np.full(len(places), centre[2] - 0.02)
    # From in front the first crossing: the face has no overhang within the features' area.
    for _ in range(28):
        point[:, 2] = (front + back) / 2
        outside = skin.value(point) > 0
        front = np.where(outside, point[:, 2], front)
        back = np.where(outside, back, point[:, 2])
    return np.asarray(point + places[:, 2:] * skin.normals(point), dtype=np.float64)


def skin_shift(local: Floats, look: Look, jaw: Floats | None = None) -> Floats:
    """Displacement [V, 3] of skin at [V, 3]: metres left, up and ahead of the middle of the head.

    `jaw` [V] is the share of the jaw's way that each vertex goes, where it is not that of skin in its place.
    """
    x, y, z = local.T
    out = np.zeros_like(local)
    ahead = 1 / (1 + np.exp(-(z - 0.03) / 0.012))
    drop = look.mouth_open * ahead * (_jaw(x, y) if jaw is None else jaw)
    out[:, 1] -= _JAW_DROP * drop
    out[:, 2] -= 0.005 * drop
    # The lips, and less and less the skin around them.
    u = x / _MOUTH_WIDTH
    v = (y - _MOUTH_Y) / 0.011
    near = np.exp(-np.square(np.maximum(np.hypot(u, v) - 1, 0) / 0.7)) * ahead
    curve = look.smile - look.frown
    out[:, 0] += x * near * (0.24 * max(look.smile, 0.0) - 0.14 * look.mouth_open - 0.34 * look.purse)
    out[:, 1] += near * 0.015 * curve * (np.minimum(u * u, 1.3) - 0.45)
    out[:, 1] -= near * v * 0.0015 * look.smile
    out[:, 2] += near * (0.007 * look.purse - 0.004 * max(look.smile, 0.0) * np.minimum(u * u, 1.3))
    for sign in (-1.0, 1.0):
        cheek = np.exp(-((x - sign * 0.042) ** 2 + (y + 0.03) ** 2) / (2 * 0.016**2)) * ahead
        rise = max(look.smile, 0.0) + 0.2 * max(look.frown, 0.0)
        out[:, 1] += 0.005 * rise * cheek
        out[:, 2] += 0.004 * rise * cheek
        above = np.exp(-((x - sign * 0.03) ** 2 + (y - 0.036) ** 2) / (2 * 0.014**2)) * ahead
        out[:, 1] += 0.003 * look.brow * above
        out[:, 2] += 0.002 * max(-look.brow, 0.0) * above
    return out


def _jaw(x: Floats, y: Floats) -> Floats:
    """Share of the jaw's way that skin goes: none above the mouth, all below, more softly beside it."""
    square = np.minimum(np.square(x / _MOUTH_WIDTH), 4.0)
    away = (_MOUTH_Y - 0.018 * square - y) / (0.0022 + 0.006 * square)
    return np.asarray(1 / (1 + np.exp(-np.clip(away, -60, 60))), dtype=np.float64)


def _fan(count: int) -> Triangles:
    """A disc of one vertex in the middle and `count` around it, counter-clockwise from in front."""
    ring = np.arange(count)
    return np.stack([np.zeros(count, np.int64), 1 + ring, 1 + (ring + 1) % count], axis=1)


def _ribbon(steps: int, rows: int = 2) -> Triangles:
    """A strip of rows of `steps` + 1 vertices, the uppermost row first, each from right to left."""
    upper = (np.arange(rows - 1)[:, None] * (steps + 1) + np.arange(steps)).ravel()
    lower = upper + steps + 1
    one = np.stack([upper, lower, lower + 1], axis=1)
    two = np.stack([upper, lower + 1, upper + 1], axis=1)
    return np.concatenate([one, two])


def _open(look: Look) -> float:
    return float(np.clip(look.eye_open, 0.04, 1.7)) * _EYE_HEIGHT


def _slant(look: Look) -> float:
    """How much higher the upper lid's inner half is than its outer one, as a share of the open eye."""
    return 0.35 * look.frown + 0.5 * min(look.brow, 0.0)


def _eye(sign: float, wide: float, high: float, lift: float) -> Callable[[Look], Floats]:
    def outline(look: Look) -> Floats:
        angle = 2 * np.pi * np.arange(_RING) / _RING
        opened = _open(look)
        tall = min(high, opened) if wide < _EYE_WIDTH else opened
        # An ellipse keeps its shape while it is cut by the lids: its points are moved onto them.
        up = np.clip(tall * np.sin(angle), -opened, opened)
        up += _slant(look) * np.maximum(up, 0) * -sign * np.cos(angle)
        ring = np.column_stack([sign * _EYE_X + wide * np.cos(angle), _EYE_Y + up, np.full(_RING, lift)])
        return np.concatenate([[[sign * _EYE_X, _EYE_Y, lift]], ring])

    return outline


def _lid(sign: float) -> Callable[[Look], Floats]:
    """The dark edge of the upper lid."""

    def outline(look: Look) -> Floats:
        angle = np.pi * (1 - np.arange(_RING + 1) / _RING)
        x = sign * _EYE_X + 1.06 * _EYE_WIDTH * np.cos(angle)
        base = _EYE_Y + _open(look) * np.sin(angle) * (1 - _slant(look) * sign * np.cos(angle))
        rows = [np.column_stack([x, base + high, np.full_like(x, 0.0024)]) for high in (0.0022, -0.0002)]
        return np.concatenate(rows)

    return outline


def _brow(sign: float) -> Callable[[Look], Floats]:
    """Lowered brows make an angry V, a frown lifts their inner ends as sorrow does."""

    def outline(look: Look) -> Floats:
        lift = look.brow
        raised = lift * (0.013 if lift > 0 else 0.004)
        inner = 0.0105 * look.frown + min(lift, 0.0) * 0.0155
        x = sign * np.array([0.0135, 0.032, 0.0525])
        y = np.array(
            [
                0.0295 + raised + inner,
                0.0365 + raised + 0.25 * inner,
                0.031 + 0.8 * raised - 0.005 * look.frown,
            ]
        )
        along = np.linspace(0, 1, 9)
        bend = np.stack([(1 - along) ** 2, 2 * along * (1 - along), along**2], axis=1)
        curve = bend @ np.column_stack([x, y])
        if sign < 0:
            curve = curve[::-1]
        thick = 0.0034 * (1 - 0.55 * (np.abs(curve[:, 0]) - 0.0135) / 0.039)
        rows = [np.column_stack([curve[:, 0], curve[:, 1] + s * thick, np.full(9, 0.0028)]) for s in (1, -1)]
        return np.concatenate(rows)

    return outline


def _mouth() -> list[Feature]:
    """Upper and lower half of the skin around the mouth and of the lips, then the hollow behind and teeth."""
    out = []
    lip = _MOUTH_WIDTH * np.linspace(-1, 1, 13)
    x = np.concatenate([[-PATCH[0], -0.035], lip[::2], [0.035, PATCH[0]]])
    border = PATCH[1] * np.sqrt(1 - np.square(x / PATCH[0]))
    part = np.sqrt(1 - np.square(lip / _MOUTH_WIDTH))
    for up, full in ((1.0, 0.0078), (-1.0, 0.0092)):

        def red(x: Floats, up: float = up, full: float = full) -> Floats:
            """Height of the lips' red above or below the line between them."""
            share = np.sqrt(np.maximum(1 - np.square(x / _MOUTH_WIDTH), 0))
            bow = 1 - 0.3 * np.exp(-np.square(x / 0.004)) if up > 0 else 1.0
            return full * share * bow

        # Its inner edge lies under the lip.
        rows = [
            (up * ((1 - s) * border + 0.85 * s * red(x)), lift)
            for s, lift in ((0.0, 0.0004), (0.5, 0.0004), (1.0, -0.001))
        ]
        out.append(_strip("skin", x, rows, up, None))
        skin = _jaw(lip, _MOUTH_Y + up * red(lip))
        profile = ((1.0, 0.0005), (0.7, 0.0028), (0.3, 0.0036), (0.0, 0.0), (-0.15, -0.007))
        rows = [(up * s * red(lip), lift * part) for s, lift in profile]
        out.append(_strip("lip", lip, rows, up, skin))
    below = _jaw(lip, _MOUTH_Y - 0.0092 * part)
    bag = [(0.0015 * part, -0.005 * part), (0 * part, -0.024 * part), (-0.0015 * part, -0.005 * part)]
    out.append(_strip("mouth", lip, bag, 1.0, np.concatenate([0 * below, 0.5 * below, below])))
    teeth = [(0.005 * part, -0.0065), (-0.0055 * part, -0.006)]
    out.append(_strip("white", 0.86 * lip, teeth, 1.0, np.zeros(2 * len(lip))))
    return out


def _strip(
    swatch: str, x: Floats, rows: Sequence[tuple[Floats, Floats | float]], up: float, jaw: Floats | None
) -> Feature:
    """Rows of (height over the line between the lips, lift off the skin), `up` from the uppermost down."""
    rows = rows if up > 0 else rows[::-1]
    places = np.concatenate(
        [np.column_stack([x, _MOUTH_Y + y, np.broadcast_to(lift, x.shape)]) for y, lift in rows]
    )
    if jaw is not None and len(jaw) == len(x):
        jaw = np.tile(jaw, len(rows))
    return Feature(swatch, _ribbon(len(x) - 1, len(rows)), lambda _: places, jaw, round=swatch != "skin")


# ARKit's blend shapes: the head has eyelids, brows, lips, cheeks and a jaw, so some of the 52 move it. The
# others (glances, tongue, nose, the jaw to the side) are there by name and leave it as it is.


@dataclass(frozen=True)
class Shape:
    """The part of a look that belongs to a shape: one side of the face, its upper or lower half, or all."""

    look: Look
    side: Literal["", "Left", "Right"] = ""
    half: Literal["", "upper", "lower"] = ""

    def mask(self, local: Floats) -> Floats:
        """Share [V] of the look's displacement at points [V, 3] from the middle of the head."""
        out = np.ones(len(local))
        if self.side:
            out *= _soft_step((local[:, 0] if self.side == "Left" else -local[:, 0]) / 0.006)
        if self.half:
            above = local[:, 1] + 0.022
            out *= _soft_step((above if self.half == "upper" else -above) / 0.004)
        return out


_SIDED: dict[str, tuple[Look, Literal["", "upper", "lower"]]] = {
    "eyeBlink": (Look(eye_open=0.0), "upper"),
    "eyeSquint": (Look(eye_open=0.6), "upper"),
    "eyeWide": (Look(eye_open=1.6), "upper"),
    "browDown": (Look(brow=-1.0), "upper"),
    "browOuterUp": (Look(brow=1.0), "upper"),
    "mouthSmile": (Look(smile=1.0), ""),
    "mouthFrown": (Look(frown=1.0), "lower"),
    "mouthLowerDown": (Look(mouth_open=0.3), "lower"),
}
_WHOLE: dict[str, Shape] = {
    "browInnerUp": Shape(Look(frown=1.0), half="upper"),
    "jawOpen": Shape(Look(mouth_open=1.0), half="lower"),
    "mouthPucker": Shape(Look(purse=1.0), half="lower"),
    "mouthFunnel": Shape(Look(purse=0.7, mouth_open=0.3), half="lower"),
}


def _soft_step(values: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-np.clip(values, -60, 60))), dtype=np.float64)


def _shape(name: str) -> Shape:
    for base, (look, half) in _SIDED.items():
        for side in ("Left", "Right"):
            if name == base + side:
                return Shape(look, side, half)  # type: ignore[arg-type]
    return _WHOLE.get(name, Shape(Look()))


ARKIT_SHAPES: dict[str, Shape] = {name: _shape(name) for name in ARKIT}
"""All 52, in ARKit's order; those that the head does not have are the neutral look."""
