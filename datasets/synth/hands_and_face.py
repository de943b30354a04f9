"""Faces, and hand shapes as finger rotations: relaxed, fist, point, spread, pinch, fingers that wave in turn.

Angles are written for the left hand of the T-pose (palm down, fingers along +X): flexion turns a finger
towards the palm, spreading turns it about Y. Finger order is SMPL-X's: index, middle, pinky, ring, thumb,
three joints each. `datasets/actions/hands.py` recognises the shapes on joints.
"""

from __future__ import annotations

import numpy as np

from motionloom.datasets.motion.body.expressions import APEX, BASIS, FACES
from motionloom.datasets.motion.body.resting_hands import RELAXED_FAN, RELAXED_FLEX, RELAXED_THUMB
from motionloom.datasets.motion.layout import FACE_DIMS
from motionloom.datasets.synth.actions.maths import Array, ease, rot_y, rot_z, wander

# Flexion of (knuckle, middle joint, last joint) for index, middle, pinky, ring; radians.
_FLEX: dict[str, tuple[tuple[float, float, float], ...]] = {
    "relaxed": RELAXED_FLEX,
    "fist": ((1.35, 1.6, 1.0), (1.4, 1.65, 1.0), (1.4, 1.6, 1.0), (1.42, 1.65, 1.0)),
    "point": ((0.02, 0.06, 0.05), (1.35, 1.6, 1.0), (1.4, 1.6, 1.0), (1.4, 1.65, 1.0)),
    "spread": ((-0.05, 0.02, 0.0), (-0.05, 0.02, 0.0), (-0.02, 0.04, 0.0), (-0.04, 0.02, 0.0)),
    "pinch": ((0.85, 0.85, 0.3), (0.35, 0.35, 0.2), (0.25, 0.25, 0.15), (0.3, 0.3, 0.2)),
    "wave_fingers": ((0.5, 0.5, 0.3), (0.5, 0.5, 0.3), (0.5, 0.5, 0.3), (0.5, 0.5, 0.3)),
}
_FAN = np.array(RELAXED_FAN)
_FAN_WIDE = np.array([-0.34, -0.08, 0.5, 0.2])
# Rotation vectors of the three thumb joints.
_THUMBS: dict[str, tuple[tuple[float, float, float], ...]] = {
    "relaxed": RELAXED_THUMB,
    "fist": ((0.7, 0.75, -0.55), (0.1, 0.6, -0.35), (0.0, 0.5, -0.2)),
    "point": ((0.7, 0.7, -0.5), (0.1, 0.55, -0.35), (0.0, 0.5, -0.2)),
    "spread": ((0.0, -0.45, 0.1), (0.0, -0.15, 0.0), (0.0, -0.05, 0.0)),
    "pinch": ((0.33, 0.59, -0.33), (0.0, -0.11, -0.11), (0.0, -0.02, -0.34)),
    "wave_fingers": ((0.25, 0.0, -0.2), (0.0, 0.1, -0.1), (0.0, 0.1, -0.1)),
}


def shape_hand(shape: str, t: Array, rng: np.random.Generator) -> Array:
    """Local finger rotations [T, 15, 3, 3] of one hand, which takes its shape in the first moments."""
    flex, fan, thumb = _angles("relaxed", rng)
    n = len(t)
    if shape == "relaxed":
        on = np.zeros(n)
    elif rng.random() < 0.5:
        on = np.ones(n)
    else:
        on = ease((t - rng.uniform(-0.1, 0.1)) / rng.uniform(0.25, 0.45))
    return _turned((flex, fan, thumb), shape, t, on, rng)


def grip_hand(shape: str, t: Array, grip: Array, rng: np.random.Generator) -> Array:
    """Local finger rotations [T, 15, 3, 3] of a hand that goes from relaxed (`grip` [T] 0) to `shape` (1)."""
    return _turned(_angles("relaxed", rng), shape, t, grip, rng)


def _turned(
    relaxed: tuple[Array, Array, Array], shape: str, t: Array, on: Array, rng: np.random.Generator
) -> Array:
    """Rotations [T, 15, 3, 3] on the way `on` [T] from a relaxed hand's angles to a shape."""
    import roma
    import torch

    flex, fan, thumb = relaxed
    n = len(t)
    to_flex, to_fan, to_thumb = _angles(shape, rng)
    mix = on[:, None, None]
    bends = flex + mix * (to_flex - flex)
    fans = fan + on[:, None] * (to_fan - fan)
    thumbs = thumb + mix * (to_thumb - thumb)
    if shape == "wave_fingers":
        rate = rng.uniform(0.9, 1.5)
        delay = np.array([0.0, 0.7, 2.1, 1.4]) * rng.choice([-1.0, 1.0])
        beat = np.sin(2 * np.pi * rate * t[:, None] + delay)
        bends = bends + mix * beat[..., None] * np.array([0.48, 0.52, 0.3])
    noise = wander(t, rng, 5, 0.02)
    bends = bends + noise[:, :4, None]
    rotations = np.empty((n, 15, 3, 3))
    base = rot_y(fans) @ rot_z(-bends[..., 0])
    for finger in range(4):
        rotations[:, 3 * finger] = base[:, finger]
    rest = rot_z(-bends[..., 1:])
    for finger in range(4):
        rotations[:, 3 * finger + 1 : 3 * finger + 3] = rest[:, finger]
    vectors = thumbs + 0.5 * noise[:, 4, None, None]
    rotations[:, 12:] = roma.rotvec_to_rotmat(torch.from_numpy(vectors)).numpy()
    return rotations


def _angles(shape: str, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Flexion [4, 3], fan [4] and thumb vectors [3, 3] of a shape, each hand a little different."""
    flex = np.array(_FLEX[shape]) * rng.uniform(0.94, 1.06)
    fan = (_FAN_WIDE if shape == "spread" else _FAN) * rng.uniform(0.85, 1.15)
    return flex, fan, np.array(_THUMBS[shape])


# Faces as trajectories of 50 values in the basis of `datasets/motion/body/expressions.py`.

_BLINK, _TALK = 4, slice(5, 8)


def express(emotion: str, t: Array, rng: np.random.Generator) -> Array:
    """Expression values [T, 50] of one emotion: onset, apex, offset, blinks and small movement on top."""
    seconds = float(t[-1]) if len(t) > 1 else 1.0
    weights = _idle(t, rng)
    if emotion != "neutral":
        onset = rng.uniform(0.15, 0.5)
        begin = rng.uniform(-0.3, 0.15 * seconds)
        release = seconds - rng.uniform(-0.5, 0.12 * seconds)
        left = rng.uniform(0.2, 0.7)
        shape = ease((t - begin) / onset) * (1 - (1 - left) * ease((t - release) / 0.4))
        strength = APEX * rng.uniform(0.75, 1.2) * (1 + 0.04 * wander(t, rng, 1, 1.0)[:, 0])
        weights[:, FACES.index(emotion) - 1] = shape * strength
    return weights @ BASIS.T + wander(t, rng, FACE_DIMS, 0.05)


def express_with(emotion: str, t: Array, strength: Array, rng: np.random.Generator) -> Array:
    """Expression values [T, 50] of an emotion as strong as `strength` [T] says (1 is an apex)."""
    weights = _idle(t, rng)
    if emotion != "neutral":
        weights[:, FACES.index(emotion) - 1] = APEX * strength * (1 + 0.04 * wander(t, rng, 1, 1.0)[:, 0])
    return weights @ BASIS.T + wander(t, rng, FACE_DIMS, 0.05)


def _idle(t: Array, rng: np.random.Generator) -> Array:
    """Weights [T, 8] of the basis while a face does nothing but blink and talk a little."""
    seconds = float(t[-1]) if len(t) > 1 else 1.0
    weights = np.zeros((len(t), 8))
    weights[:, _TALK] = wander(t, rng, 3, 0.35)
    at = rng.uniform(-0.5, 2.0)
    while at < seconds:
        weights[:, _BLINK] += 1.6 * np.exp(-(((t - at) / 0.06) ** 2))
        at += rng.uniform(1.2, 3.5)
    return weights
