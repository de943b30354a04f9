"""The fourth joint of a leg, the ball of the foot, where no name says it: below the ankle, at its End Site,
or estimated.

An estimate stands at right angles to the shin, forward of the hips, as far away as in our own skeleton, and
is written into the joint map as an End Site of the ankle.
"""

from __future__ import annotations

from dataclasses import replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.convert.bvh.joint_guess.figure import Figure
from motionloom.datasets.convert.bvh.joint_guess.limbs import Limb, Limbs, Rows
from motionloom.datasets.motion.skeleton import Skeleton

_NAMED = Skeleton.named("smpl22")
_BALL = _NAMED.offsets[_NAMED.index("left_foot")]
_SHIN = float(np.linalg.norm(_NAMED.offsets[_NAMED.index("left_ankle")]))
_FORWARD, _DOWN = float(_BALL[2]) / _SHIN, -float(_BALL[1]) / _SHIN
"""From the ankle to the ball of the foot, in lengths of the shin."""
_FOOT = (0.12, 0.75)
"""How far a foot's End Site is from the ankle, in lengths of the shin: a ball to a long shoe [ours]."""
_AHEAD = 0.5
"""Cosine between the way to it and forward that it has at least: others point down, or back to a heel."""


def with_feet(figure: Figure, legs: Limbs, rows: Rows) -> Limbs:
    """The legs with their fourth slot, where it is certain; a row for every foot or a doubt."""
    made, open_legs = [], 0
    for leg in legs:
        ankle, toe = leg.slots[2], leg.slots[3]
        assert ankle is not None
        below = figure.children[ankle]
        while toe is None and len(below) == 1:
            toe = None if figure.coincide(below[0], ankle) else below[0]
            below = figure.children[below[0]]
        if toe is not None and leg.slots[3] is None:
            rows.put(f"{leg.side}_foot", [toe], "hierarchy")
        elif toe is None and below:
            rows.doubt(f"{leg.side}_foot", below)
        open_legs += toe is None and not below
        made.append(replace(leg, slots=(*leg.slots[:3], toe)))
    if open_legs == len(made):
        _end_feet(figure, legs, rows)
    else:
        for leg in made:
            if leg.slots[3] is None and f"{leg.side}_foot" not in rows.candidates:
                rows.doubt(f"{leg.side}_foot", ())
    return made[0], made[1]


def _end_feet(figure: Figure, legs: Limbs, rows: Rows) -> None:
    """Rows for both feet: their End Sites where both are feet, else the estimates."""
    hips = [figure.poses[:, leg.essential()[0]] for leg in legs]
    ends = []
    for leg in legs:
        _, knee, ankle = (figure.poses[:, joint] for joint in leg.essential())
        shin = figure.length(*leg.essential()[1:])
        forward = _unit(np.cross(hips[0] - hips[1], knee - ankle))
        end = figure.end_of(leg.essential()[2])
        if end is not None:
            way = figure.poses[:, end] - ankle
            length = np.median(np.linalg.norm(way, axis=-1)) / shin
            ahead = np.median(np.sum(_unit(way) * forward, axis=-1))
            ends.append(end if _FOOT[0] < length < _FOOT[1] and ahead > _AHEAD else None)
        ball = _FORWARD * forward + _DOWN * _unit(ankle - knee)
        local = np.einsum("tji,tj->ti", _turned(figure, leg), ball).mean(axis=0)
        share = shin / figure.length(figure.parents[leg.essential()[2]], leg.essential()[2])
        x, y, z = (local * (share * np.hypot(_FORWARD, _DOWN) / np.linalg.norm(local))).tolist()
        rows.ends[leg.essential()[2]] = (x, y, z)
    found = [end for end in ends if end is not None]
    for number, leg in enumerate(legs):
        if len(found) == len(legs):
            rows.ends.clear()
            rows.put(f"{leg.side}_foot", [found[number]], "end")
        else:
            rows.put(f"{leg.side}_foot", [leg.essential()[2]], "estimate")


def _turned(figure: Figure, leg: Limb) -> NDArray[np.float64]:
    """Rotations [K, 3, 3] of the ankle in the world, in every pose."""
    chain = figure.ancestors(leg.essential()[2])[::-1]
    turns: NDArray[np.float64] = reduce(np.matmul, figure.motion.local_rotations(chain))
    return turns


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))
