"""The joint map of a figure whose joints a known tool has named (`tools.py`).

1. Legs and arms are those of the first convention that has all their names, on both sides. Where none has,
   words of several tools count that stand in a limb's order along one chain, alike on both sides; one of the
   three joints may have a strange name where the tree leaves only it.
2. Pelvis, spine and neck lie between and above them: a joint that is missing is a mean of its neighbours.
3. The ball of a foot without a name is the only joint below the ankle or its End Site, or estimated: at right
   angles to the shin, forward of the hips, as far away as in our own skeleton, written into the map as an End
   Site.
4. Fingers by name alone: too many hands have four joints a finger.

What is not certain is not guessed: its row stays empty. All of it is [ours]. Whether names tell the truth is
seen when the clips are (`datasets/motion/plausibility.py`). Nothing depends on the figure's unit or up axis.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import reduce
from itertools import islice, pairwise, product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.convert.bvh.tools import CONVENTIONS, ENDS, FINGERS, WORDS, read_names
from motionloom.datasets.motion.bvh.joint_map import JointMap
from motionloom.datasets.motion.bvh.motion import END, BvhMotion
from motionloom.datasets.motion.skeleton import Skeleton

_POSES = 16
"""Frames looked at, spread over the clip [ours]. Many tools' rest poses (LAFAN1, Bandai-Namco, BONES) are no
figures: all bones lie along one axis.
"""
_SAME_PLACE = 2e-3
"""Joints nearer to each other than this share of the figure's extent are one place (3 mm) [ours]."""
_NEAR_HIPS = 0.4
"""The pelvis is within this share of a leg from the middle of the hips; a root on the floor is not [ours]."""

_NAMED = Skeleton.named("smpl22")
_BALL = _NAMED.offsets[_NAMED.index("left_foot")]
_SHIN = float(np.linalg.norm(_NAMED.offsets[_NAMED.index("left_ankle")]))
_FORWARD, _DOWN = float(_BALL[2]) / _SHIN, -float(_BALL[1]) / _SHIN
"""From the ankle to the ball of the foot, in lengths of the shin."""
_FOOT = (0.12, 0.75)
"""Distance of a foot's End Site from the ankle in lengths of the shin: a ball to a long shoe [ours]."""
_AHEAD = 0.5
"""Cosine between the way to it and forward that it has at least: others point down, or back to a heel."""

_CHOICES = 20_000
"""Joints of one limb that are tried: hands of strange names have hundreds, a file of one name billions."""

_SIDES = ("left", "right")
Kind = Literal["leg", "arm"]
Limb = tuple[int, int, int]
"""Hip, knee and ankle, or shoulder, elbow and wrist."""


def guess_joint_map(motion: BvhMotion, target: Skeleton) -> JointMap:
    """The joints of a clip that stand for those of `target` (`smpl22` or `smplx52`); rows of what is not
    certain are empty, as are those of names that two joints have.
    """
    figure = _Figure(motion)
    rows: dict[str, tuple[int, ...]] = {}
    ends: dict[str, tuple[float, float, float]] = {}
    legs, arms = (figure.limbs(kind) for kind in ("leg", "arm"))
    if legs is not None and arms is not None:
        feet, ends = _feet(figure, legs)
        rows = {**_trunk(figure, legs, arms), **feet}
        for side, arm in zip(_SIDES, arms, strict=True):
            rows |= _fingers(figure, side, arm[2])
    for words, limbs in ((("hip", "knee", "ankle"), legs), (("shoulder", "elbow", "wrist"), arms)):
        for side, limb in zip(_SIDES, limbs or (), strict=False):
            rows |= {f"{side}_{word}": (joint,) for word, joint in zip(words, limb, strict=True)}
    names = [*figure.joints, *map(END.format, motion.joints)]
    counts = Counter(motion.joints)
    sources = [tuple(names[joint] for joint in rows.get(joint, ())) for joint in target.joints]
    certain = tuple(one if all(counts[name] < 2 for name in one) else () for one in sources)
    used = {name for one in certain for name in one}
    unmapped = tuple(name for name in dict.fromkeys(motion.joints) if name not in used)
    return JointMap(f"guessed from {motion.name}", target, certain, unmapped, ends=ends)


def summary(guess: JointMap) -> str:
    """One line that counts how the joints were found, and says which were not."""
    feet = {name for names in guess.sources for name in names if name.startswith(END.format(""))}
    means = sum(len(names) > 1 for names in guess.sources)
    named = len(guess.sources) - len(guess.open_rows) - means - len(feet)
    counts = {
        "by name and tree": named, "as means": means,
        "estimated" if guess.ends else "at End Sites": len(feet), "open": len(guess.open_rows),
    }  # fmt: skip
    found = ", ".join(f"{count} {how}" for how, count in counts.items() if count)
    return f"{found}; {len(guess.unmapped)} of the source's joints stand for nothing"


class _Figure:
    """A clip's joints, its End Sites behind them, in some of its frames."""

    def __init__(self, motion: BvhMotion) -> None:
        chosen = np.unique(np.linspace(0, motion.frames - 1, _POSES).round().astype(int))
        self.motion = replace(motion, values=motion.values[chosen])
        ended = self.motion.with_ends()
        self.joints = ended.joints
        self.parents = ended.parents
        self.poses = ended.positions()
        self.read = read_names(motion.joints)
        counts = Counter(self.read)
        self.named = {key: joint for joint, key in enumerate(self.read) if counts[key] == 1}
        self.extent = float(np.median(np.ptp(self.poses, axis=1).max(axis=-1)))

    def length(self, a: int, b: int) -> float:
        return float(np.median(np.linalg.norm(self.poses[:, a] - self.poses[:, b], axis=-1)))

    def ancestors(self, joint: int) -> list[int]:
        """The joint, its parent, and so on to the root."""
        out = []
        while joint >= 0:
            out.append(joint)
            joint = self.parents[joint]
        return out

    def is_chain(self, *joints: int) -> bool:
        """Whether each is above the next."""
        return all(a != b and a in self.ancestors(b) for a, b in pairwise(joints))

    def below(self, joint: int) -> list[int]:
        """Joints and End Sites below a joint, without those that lie at its place."""
        near = _SAME_PLACE * self.extent
        places = range(joint + 1, len(self.parents))
        return [one for one in places if self.is_chain(joint, one) and self.length(joint, one) >= near]

    def branch(self, *joints: int) -> int:
        """The lowest joint that is above all."""
        return next(a for a in self.ancestors(joints[0]) if all(a in self.ancestors(b) for b in joints))

    def way(self, above: int, below: int) -> list[int]:
        """Joints from `above` (left out) down to `below`, without those that lie on the one before them."""
        out = [above]
        up = self.ancestors(below)
        for joint in reversed(up[: up.index(above)]):
            if self.length(joint, out[-1]) >= _SAME_PLACE * self.extent:
                out.append(joint)
        return out[1:]

    def limbs(self, kind: Kind) -> tuple[Limb, Limb] | None:
        """The left and the right one, in the words of the first tool that fits."""
        first = int(kind == "arm")  # an arm's first word is the collar
        for known in CONVENTIONS:
            words = getattr(known, kind)[first : first + 3]
            left, right = ([self.named.get((side, word), -1) for word in words] for side in _SIDES)
            if min(*left, *right) >= 0 and self._is_whole(kind, left) and self._is_whole(kind, right):
                return (left[0], left[1], left[2]), (right[0], right[1], right[2])
        one, other = (self._limb(kind, side) for side in _SIDES)
        words = [[self.read[joint][1] for joint in limb or ()] for limb in (one, other)]
        return (one, other) if one and other and words[0] == words[1] else None

    def _is_whole(self, kind: Kind, limb: list[int]) -> bool:
        """Whether each is above the next, and no other joint between them has a word of such a limb."""
        words = {word for known in CONVENTIONS for word in getattr(known, kind)}
        own = tuple(self.read[joint][1] for joint in limb)
        # `upperarm1` is a part of `upperarm`.
        return self.is_chain(*limb) and not any(
            word in words and not word.startswith(own)
            for _, word in map(self.read.__getitem__, self.way(limb[0], limb[2]))
        )

    def _limb(self, kind: Kind, side: str) -> Limb | None:
        """One whose words are of several tools, or of which one joint has a strange name; None in doubt."""
        first = int(kind == "arm")
        rows = [getattr(known, kind) for known in CONVENTIONS]
        own = {joint: word for joint, (where, word) in enumerate(self.read) if where == side and word}
        fits = [[joint for joint, word in own.items() if word in slot] for slot in zip(*rows, strict=True)]
        strange = [joint for joint, word in own.items() if word not in WORDS and not word.endswith(ENDS)]
        for holes in ((-1,), range(first, first + 3)):
            found: dict[tuple[bool, int], set[Limb]] = {}
            for hole in holes:
                places = [strange if slot == hole else fit for slot, fit in enumerate(fits)]
                places[0 if first else 3] = [-1, *fits[0 if first else 3]]
                # One word may mean two joints: `leg` is a knee or a hip. The others of its chain tell which.
                for choice in islice(product(*places), _CHOICES):
                    if self.is_chain(*(joint for joint in choice if joint >= 0)):
                        words = [own.get(joint) for joint in choice]
                        agree = max(sum(a == b for a, b in zip(words, row, strict=True)) for row in rows)
                        a, b, c = choice[first : first + 3]
                        found.setdefault((min(choice) >= 0, agree), set()).add((a, b, c))
            best = found[max(found)] if found else set()
            limb = best.pop() if len(best) == 1 else None
            # A joint between two of them could as well be one of the three.
            if limb and all(len(self.way(a, b)) == 1 for a, b in pairwise(limb)):
                return limb
        return None


def _trunk(figure: _Figure, legs: tuple[Limb, Limb], arms: tuple[Limb, Limb]) -> dict[str, tuple[int, ...]]:
    """Rows of the pelvis, the spine, neck, head and collars."""
    rows: dict[str, tuple[int, ...]] = {}
    shoulders = [arm[0] for arm in arms]
    chest = figure.branch(*shoulders)
    pelvis = figure.branch(legs[0][0], legs[1][0], chest)
    hips = figure.poses[:, [leg[0] for leg in legs]].mean(axis=1)
    hip, knee, ankle = legs[0]
    reach = _NEAR_HIPS * (figure.length(hip, knee) + figure.length(knee, ankle))
    if np.median(np.linalg.norm(figure.poses[:, pelvis] - hips, axis=-1)) < reach:
        rows["pelvis"] = (pelvis,)
    hung = "neck" in figure.joints[chest].lower() and chest != pelvis  # 3ds Max hangs the collars on the neck
    rows |= _spine(pelvis, figure.way(pelvis, figure.parents[chest] if hung else chest))
    heads = [figure.named.get(("", known.neck[1]), -1) for known in CONVENTIONS]
    head = next((joint for joint in heads if joint >= 0 and figure.is_chain(chest, joint)), None)
    if head is None:
        # A strange neck and head are certain when they are all there is: of three, any two could be meant.
        free = [
            joint
            for joint in figure.below(chest)
            if joint < len(figure.motion.joints)
            and not figure.read[joint][1].endswith(ENDS)
            and all(figure.branch(joint, shoulder) == chest for shoulder in shoulders)
        ]
        head = free[-1] if len(free) == 2 - hung and figure.is_chain(*free) else None
    if head is not None:
        necks = [chest] if hung else figure.way(chest, figure.parents[head])
        # An ASF's lower neck begins where the collars do: a neck is above them.
        collar = next(iter(figure.way(chest, shoulders[0])), chest)
        if len(necks) > 1 and figure.length(necks[0], collar) < _SAME_PLACE * figure.extent:
            del necks[0]
        rows |= {"head": (head,), "neck": tuple(necks[:1]) or (chest, head, head)}
    for side, shoulder in zip(_SIDES, shoulders, strict=True):
        named = [figure.named.get((side, known.arm[0]), -1) for known in CONVENTIONS]
        own = [joint for joint in named if joint >= 0 and figure.is_chain(chest, joint, shoulder)]
        between = own[:1] or figure.way(chest, shoulder)[:-1]
        if len(between) < 2:  # our collar lies in the middle of these three to 2 cm
            rows[f"{side}_collar"] = tuple(between) or (chest, *rows.get("neck", ())[:1], shoulder)
    return rows


def _spine(pelvis: int, spine: list[int]) -> dict[str, tuple[int, ...]]:
    """Three of any number of spine joints [ours]: the lowest, the middle and that of the collars."""
    middle = tuple(spine[(len(spine) - 1) // 2 : len(spine) // 2 + 1])
    by_count: dict[int, tuple[tuple[int, ...], ...]] = {
        0: (),
        1: ((pelvis, pelvis, *spine), (pelvis, *spine, *spine), middle),
        2: ((pelvis, *spine[:1]), (*spine[:1],), (*spine[1:],)),
    }
    chosen = by_count.get(len(spine), ((*spine[:1],), middle, (*spine[-1:],)))
    return dict(zip(("spine1", "spine2", "spine3"), chosen, strict=False))


def _fingers(figure: _Figure, side: str, wrist: int) -> dict[str, tuple[int, ...]]:
    """Rows of the fingers below a wrist: the knuckle and the two joints after it."""
    rows: dict[str, tuple[int, ...]] = {}
    for finger in FINGERS:
        chains = [
            [joint for word in known.fingers.get(finger, ()) if (joint := figure.named.get((side, word)))]
            for known in CONVENTIONS
        ]
        chain = max((chain for chain in chains if figure.is_chain(wrist, *chain)), key=len)
        if len(chain) > 2:
            # Four joints begin in the palm (SOMA), where the longest bone is, or end at the tip (Mixamo).
            in_palm = figure.length(chain[0], chain[1]) > figure.length(wrist, chain[0])
            first = int(len(chain) > 3 and finger != "thumb" and in_palm)
            found = enumerate(chain[first : first + 3], 1)
            rows |= {f"{side}_{finger}{number}": (joint,) for number, joint in found}
    return rows


def _feet(
    figure: _Figure, legs: tuple[Limb, Limb]
) -> tuple[dict[str, tuple[int, ...]], dict[str, tuple[float, float, float]]]:
    """Rows of both feet, and the End Sites of ankles that are estimated."""
    words = [known.leg[3] for known in CONVENTIONS]
    toes: dict[str, tuple[int, ...]] = {}
    below = [figure.below(leg[2]) for leg in legs]
    for side, joints in zip(_SIDES, below, strict=True):
        named = [figure.named.get((side, word), -1) for word in words]
        if own := [joint for joint in named if joint in joints]:
            toes[f"{side}_foot"] = (own[0],)
    # Of two feet, one open is rather a wrong name; and so is one with a toe beside a heel.
    if toes or not all(figure.is_chain(*joints) for joints in below):
        return toes, {}
    hips = [figure.poses[:, leg[0]] for leg in legs]
    found: dict[str, tuple[int, ...]] = {}
    ends: dict[str, tuple[float, float, float]] = {}
    for side, (_, knee, ankle), ends_below in zip(_SIDES, legs, below, strict=True):
        bone = figure.poses[:, ankle] - figure.poses[:, knee]
        shin = figure.length(knee, ankle)
        forward = _unit(np.cross(hips[0] - hips[1], -bone))
        for end in ends_below[:1]:
            way = figure.poses[:, end] - figure.poses[:, ankle]
            length = np.median(np.linalg.norm(way, axis=-1)) / shin
            ahead = np.median(np.sum(_unit(way) * forward, axis=-1))
            if _FOOT[0] < length < _FOOT[1] and ahead > _AHEAD:
                found[f"{side}_foot"] = (end,)
        ball = _FORWARD * forward + _DOWN * _unit(bone)
        chain = figure.ancestors(ankle)[::-1]
        turned: NDArray[np.float64] = reduce(np.matmul, figure.motion.local_rotations(chain))
        local = np.einsum("tji,tj->ti", turned, ball).mean(axis=0)
        share = shin / figure.length(figure.parents[ankle], ankle)
        x, y, z = (local * (share * np.hypot(_FORWARD, _DOWN) / np.linalg.norm(local))).tolist()
        ends[figure.joints[ankle]] = (x, y, z)
    # An estimate is for figures without any foot joint.
    if len(found) == len(legs) or any(joints[0] < len(figure.motion.joints) for joints in below if joints):
        return (found if len(found) == len(legs) else {}), {}
    behind = len(figure.joints)  # names of all joints' End Sites
    return {f"{side}_foot": (behind + leg[2],) for side, leg in zip(_SIDES, legs, strict=True)}, ends


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))
