"""The face: eyes, brows and mouth laid on the head, and the expressions as displacements of its vertices.

An expression is what the five controls of the face make of it (`pipeline/render/body/face.py`).
Each becomes one morph target, and targets add up: sadness and a blink are the sum of both. The skin moves
too: cheeks rise with a smile, the jaw drops with an open mouth. Talking (columns 5 to 7 of the synthetic
basis, to which its source gives no shape) opens, widens and purses the mouth **[ours]**.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from field import Field
from numpy.typing import NDArray

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
    "sad": Look(brow=0.35, eye_open=0.85, frown=1.0),
    "angry": Look(brow=-0.9, eye_open=0.8, frown=0.6),
    "surprised": Look(brow=1.0, eye_open=1.6, mouth_open=0.9),
    "blink": Look(eye_open=0.0),
    "talk_open": Look(mouth_open=0.35),
    "talk_wide": Look(smile=0.25, mouth_open=0.1),
    "talk_purse": Look(purse=1.0, mouth_open=0.1),
}
"""What each column of the synthetic basis looks like at its apex, in the basis' order."""

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
"""One look for each end of the drawn face's controls: what page, film and pictures move the face by."""

_EYE_WIDTH, _EYE_HEIGHT, _EYE_X, _EYE_Y = 0.0165, 0.0108, 0.0325, 0.006
_RING = 24


@dataclass(frozen=True)
class Feature:
    """A patch on the face: vertices as a function of the look, in face coordinates."""

    swatch: str
    triangles: Triangles
    outline: Callable[[Look], Floats]
    """[V, 3]: left, up, lift off the skin; metres from the middle of the head."""


def features() -> list[Feature]:
    """Eyes, pupils, brows, the inside of the mouth and the lips."""
    out = []
    for sign in (-1.0, 1.0):
        out.append(Feature("white", _fan(_RING), _eye(sign, _EYE_WIDTH, _EYE_HEIGHT, 0.0012)))
        out.append(Feature("dark", _fan(_RING), _eye(sign, 0.0078, 0.0084, 0.002)))
        out.append(Feature("dark", _ribbon(_RING), _lid(sign)))
        out.append(Feature("hair", _ribbon(8), _brow(sign)))
    out.append(Feature("mouth", _ribbon(12), _mouth))
    out += [Feature("lip", _ribbon(12), _lip(upper)) for upper in (True, False)]
    return out


def on_skin(skin: Field, centre: Floats, places: Floats) -> Floats:
    """World points [V, 3] of face coordinates [V, 3]: straight back onto the skin, then lifted off it."""
    point = centre + np.column_stack([places[:, :2], np.full(len(places), 0.16)])
    front, back = point[:, 2].copy(), np.full(len(places), centre[2] - 0.02)
    # From in front the first crossing: the face has no overhang within the features' area.
    for _ in range(28):
        point[:, 2] = (front + back) / 2
        outside = skin.value(point) > 0
        front, back = np.where(outside, point[:, 2], front), np.where(outside, back, point[:, 2])
    return np.asarray(point + places[:, 2:] * skin.normals(point), dtype=np.float64)


def skin_shift(local: Floats, look: Look) -> Floats:
    """Displacement [V, 3] of skin at [V, 3]: metres left, up and ahead of the middle of the head."""
    x, y, z = local.T
    out = np.zeros_like(local)
    ahead = 1 / (1 + np.exp(-(z - 0.03) / 0.012))
    # The jaw: everything in front and below the mouth, softly.
    jaw = ahead / (1 + np.exp((y + 0.058) / 0.008))
    out[:, 1] -= 0.017 * look.mouth_open * jaw
    out[:, 2] -= 0.004 * look.mouth_open * jaw
    for sign in (-1.0, 1.0):
        cheek = np.exp(-((x - sign * 0.042) ** 2 + (y + 0.03) ** 2) / (2 * 0.016**2)) * ahead
        rise = max(look.smile, 0.0) + 0.2 * max(look.frown, 0.0)
        out[:, 1] += 0.005 * rise * cheek
        out[:, 2] += 0.004 * rise * cheek
        above = np.exp(-((x - sign * 0.03) ** 2 + (y - 0.036) ** 2) / (2 * 0.014**2)) * ahead
        out[:, 1] += 0.003 * look.brow * above
        out[:, 2] += 0.002 * max(-look.brow, 0.0) * above
    return out


def _fan(count: int) -> Triangles:
    """A disc of one vertex in the middle and `count` around it, counter-clockwise from in front."""
    ring = np.arange(count)
    return np.stack([np.zeros(count, np.int64), 1 + ring, 1 + (ring + 1) % count], axis=1)


def _ribbon(steps: int) -> Triangles:
    """A strip of two rows of `steps` + 1 vertices, the upper row first, each from right to left."""
    k = np.arange(steps)
    upper, lower = k, k + steps + 1
    one = np.stack([upper, lower, lower + 1], axis=1)
    two = np.stack([upper, lower + 1, upper + 1], axis=1)
    return np.concatenate([one, two])


def _open(look: Look) -> float:
    return float(np.clip(look.eye_open, 0.04, 1.7)) * _EYE_HEIGHT


def _eye(sign: float, wide: float, high: float, lift: float) -> Callable[[Look], Floats]:
    def outline(look: Look) -> Floats:
        angle = 2 * np.pi * np.arange(_RING) / _RING
        opened = _open(look)
        tall = min(high, opened) if wide < _EYE_WIDTH else opened
        # An ellipse keeps its shape while it is cut by the lids: its points are moved onto them.
        up = np.clip(tall * np.sin(angle), -opened, opened)
        ring = np.column_stack([sign * _EYE_X + wide * np.cos(angle), _EYE_Y + up, np.full(_RING, lift)])
        return np.concatenate([[[sign * _EYE_X, _EYE_Y, lift]], ring])

    return outline


def _lid(sign: float) -> Callable[[Look], Floats]:
    """The dark edge of the upper lid."""

    def outline(look: Look) -> Floats:
        angle = np.pi * (1 - np.arange(_RING + 1) / _RING)
        x = sign * _EYE_X + 1.06 * _EYE_WIDTH * np.cos(angle)
        base = _EYE_Y + _open(look) * np.sin(angle)
        rows = [np.column_stack([x, base + high, np.full_like(x, 0.0024)]) for high in (0.0022, -0.0002)]
        return np.concatenate(rows)

    return outline


def _brow(sign: float) -> Callable[[Look], Floats]:
    """Lowered brows make an angry V, a frown lifts their inner ends as sorrow does."""

    def outline(look: Look) -> Floats:
        lift = look.brow
        raised = lift * (0.013 if lift > 0 else 0.004)
        inner = 0.007 * look.frown + min(lift, 0.0) * 0.013
        x = sign * np.array([0.0135, 0.032, 0.0525])
        y = np.array(
            [
                0.0295 + raised + inner,
                0.0365 + raised + 0.25 * inner,
                0.031 + 0.8 * raised - 0.003 * look.frown,
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


def _lips(look: Look) -> tuple[Floats, Floats]:
    """The upper and the lower edge of the mouth [13, 2], from right to left."""
    curve = float(np.clip(look.smile - look.frown, -1.5, 1.5))
    opened = look.mouth_open
    wide = 0.026 + 0.006 * max(curve, 0.0) - 0.005 * min(opened, 1.0) - 0.008 * look.purse
    u = np.linspace(-1, 1, 13)
    middle = -0.054 + 0.015 * curve * (u * u - 0.45)
    part = 1 - u * u
    upper = np.column_stack([wide * u, middle + 0.004 * opened * part])
    lower = np.column_stack([wide * u, middle - 0.023 * opened * part])
    return upper, lower


def _mouth(look: Look) -> Floats:
    return np.concatenate([np.column_stack([row, np.full(len(row), 0.0012)]) for row in _lips(look)])


def _lip(upper: bool) -> Callable[[Look], Floats]:
    def outline(look: Look) -> Floats:
        edge = _lips(look)[0 if upper else 1]
        full = (0.0042 if upper else 0.0052) * (1 - 0.75 * np.linspace(-1, 1, 13) ** 2)
        high, low = (full, -0.0004) if upper else (0.0004, -full)
        rows = [np.column_stack([edge[:, 0], edge[:, 1] + side, np.full(13, 0.002)]) for side in (high, low)]
        return np.concatenate(rows)

    return outline
