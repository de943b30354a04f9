"""Guess the joint map of any figure: names first, checked and completed by its tree and by its poses.

1. Legs and arms by the words of their names along a chain, else as mirrored branches (`limbs.py`).
2. Left and right as the names say, if the pose does not contradict, else as the pose says (`sides.py`).
3. Pelvis, spine, neck and head between and above them (`trunk.py`); fingers by name (`fingers.py`).
4. A joint that is missing between two others is a mean of its neighbours.

What is not certain is not guessed: the row stays empty, with what it could be. All of it is [ours].
"""

from __future__ import annotations

from collections import Counter

from motionloom.datasets.motion.bvh import BvhMotion
from motionloom.datasets.motion.joint_guess.conventions import CONVENTIONS
from motionloom.datasets.motion.joint_guess.figure import Figure
from motionloom.datasets.motion.joint_guess.fingers import fill_fingers
from motionloom.datasets.motion.joint_guess.limbs import Kind, Limb
from motionloom.datasets.motion.joint_guess.result import GuessedJoint, JointGuess
from motionloom.datasets.motion.joint_guess.sides import CLEAR, LimbPair, find_pairs, handedness
from motionloom.datasets.motion.joint_guess.trunk import Rows, fill_trunk
from motionloom.datasets.motion.skeleton import Skeleton

_SLOTS: dict[Kind, tuple[str, str, str, str]] = {
    "leg": ("hip", "knee", "ankle", "foot"),
    "arm": ("collar", "shoulder", "elbow", "wrist"),
}

_UNEVEN = 0.25
"""Long bones of left and right differ by at most this share, or one of them is another joint [ours]."""
_ALIKE = 2.5
"""The two long bones of a limb differ by at most this factor (those of people by 1.3) [ours]."""


def guess_joint_map(motion: BvhMotion, target: Skeleton) -> JointGuess:
    """Guess which joints of a clip stand for those of `target` (`smpl22` or `smplx52`)."""
    figure, rows = Figure.of(motion), Rows()
    legs, arms = find_pairs(figure)
    problems: list[str] = []
    if legs is None or arms is None:
        kinds = [kind for kind, pair in (("legs", legs), ("arms", arms)) if pair is None]
        problems.append(f"found no {' and no '.join(kinds)}, by name or as two branches with equal bones")
        for pair in (legs, arms):
            if pair is not None and pair.sides_named:
                _fill_limbs(figure, pair, rows)
        _fill_by_words(figure, rows)
    else:
        legs = _with_feet(figure, legs, rows)
        legs, arms = (_sided(figure, pair, legs, problems) for pair in (legs, arms))
        fill_trunk(figure, legs, arms, rows)
        for pair in (legs, arms):
            _fill_limbs(figure, pair, rows)
            problems.extend(_disproportions(figure, pair))
        _fill_collars(figure, arms, rows)
        problems.extend(_contradictions(figure, rows))
        for side, arm in (("left", arms.left), ("right", arms.right)):
            fill_fingers(figure, side, arm, rows)
    return _guess(figure, motion.name, target, rows, problems)


def _with_feet(figure: Figure, legs: LimbPair, rows: Rows) -> LimbPair:
    """Legs whose fourth slot, where no name filled it, is the only joint that follows on the ankle."""
    done: list[Limb] = []
    for side, leg in (("left", legs.left), ("right", legs.right)):
        ankle, toe = leg.slots[2], leg.slots[3]
        assert ankle is not None
        below = figure.children[ankle]
        while toe is None and len(below) == 1:
            toe = None if figure.coincide(below[0], ankle) else below[0]
            below = figure.children[below[0]]
        if toe is not None and leg.slots[3] is None:
            rows.put(f"{side}_foot", [toe], "hierarchy")
        elif toe is None:
            rows.doubt(f"{side}_foot", below)
        done.append(Limb((*leg.slots[:3], toe), leg.how, leg.rivals))
    return LimbPair("leg", done[0], done[1], legs.sides_named)


def _sided(figure: Figure, pair: LimbPair, legs: LimbPair, problems: list[str]) -> LimbPair:
    """The pair with its sides checked against the pose, or taken from it where no name gives them."""
    cosine = handedness(figure, pair, legs)
    if pair.sides_named:
        if cosine < -CLEAR:
            name = figure.joints[pair.left.essential(pair.kind)[0]]
            problems.append(
                f"the names call '{name}' the left {pair.kind}, but as the feet point it is the right"
            )
    elif abs(cosine) < CLEAR:
        problems.append(f"nothing says which of the two {pair.kind}s is the left one")
    return pair.swapped if not pair.sides_named and cosine < 0 else pair


def _fill_limbs(figure: Figure, pair: LimbPair, rows: Rows) -> None:
    for side, limb in (("left", pair.left), ("right", pair.right)):
        for word, joint, rivals in zip(_SLOTS[pair.kind], limb.slots, limb.rivals, strict=True):
            name = f"{side}_{word}"
            if rivals:
                rows.doubt(name, rivals)
            elif joint is not None and name not in rows.sources:
                rows.put(name, [joint], limb.how)


def _fill_by_words(figure: Figure, rows: Rows) -> None:
    """What single names say where a figure makes no whole: for the one who completes the map."""
    slots: list[tuple[str, str, set[str]]] = [
        *(("", joint, {known.neck[i] for known in CONVENTIONS}) for i, joint in enumerate(("neck", "head"))),
        ("", "pelvis", {known.trunk[0] for known in CONVENTIONS}),
    ]
    for kind, words in _SLOTS.items():
        for i, word in enumerate(words):
            fits = {getattr(known, kind)[i] for known in CONVENTIONS}
            slots += [(side, f"{side}_{word}", fits) for side in ("left", "right")]
    for side, joint, fits in slots:
        if joint not in rows.sources:
            found = [j for j, n in enumerate(figure.names) if n.word in fits - {""} and n.side == side]
            if found:
                rows.doubt(joint, found)


def _fill_collars(figure: Figure, arms: LimbPair, rows: Rows) -> None:
    """Collars without a name: the only joint between chest and shoulder, else the mean of what is around."""
    chest = figure.common_ancestor(arms.roots)
    for side, arm in (("left", arms.left), ("right", arms.right)):
        shoulder, collar = arm.essential("arm")[0], f"{side}_collar"
        if collar in rows.sources or collar in rows.candidates:
            continue
        between = figure.apart(chest, figure.path(chest, shoulder))[:-1]
        if len(between) == 1:
            rows.put(collar, between, "hierarchy")
        elif between:
            rows.doubt(collar, between)
        else:  # our collar lies in the middle of these three to 2 cm
            rows.put(collar, [chest, *rows.sources.get("neck", ())[:1], shoulder], "mean")


def _contradictions(figure: Figure, rows: Rows) -> list[str]:
    """Names that say another side than their row: where the tree or the pose found the limb."""
    other = {"left": "right", "right": "left"}
    return [
        f"'{figure.joints[joint]}' would be {row}"
        for row, joints in rows.sources.items()
        for joint in joints
        if figure.names[joint].side == other.get(row.partition("_")[0], "none")
    ]


def _disproportions(figure: Figure, pair: LimbPair) -> list[str]:
    """Long bones that no person has: then a name stands on another joint."""
    lengths = []
    for limb in (pair.left, pair.right):
        a, b, c = limb.essential(pair.kind)
        lengths.append((figure.length(a, b), figure.length(b, c)))
    uneven = any(abs(a - b) > _UNEVEN * max(a, b) for a, b in zip(*lengths, strict=True))
    unlike = any(max(bones) > _ALIKE * min(bones) for bones in lengths)
    found = []
    if uneven:
        found.append(f"the bones of the left and the right {pair.kind} have different lengths")
    if unlike:
        found.append(f"one of the two long bones of the {pair.kind}s is over {_ALIKE:g} times the other")
    return found


def _guess(figure: Figure, source: str, target: Skeleton, rows: Rows, problems: list[str]) -> JointGuess:
    """The result, in names."""

    def named(joints: tuple[int, ...]) -> tuple[str, ...]:
        return tuple(figure.joints[joint] for joint in joints)

    made = []
    for joint in target.joints:
        how = rows.how[joint] if joint in rows.sources else "missing"
        candidates = named(rows.candidates.get(joint, ()))
        made.append(GuessedJoint(joint, named(rows.sources.get(joint, ())), how, candidates))
    used = {name for row in made for name in row.sources}
    counts = Counter(figure.joints)
    twice = sorted(name for name in used if counts[name] > 1)
    if twice:
        problems.append(f"{', '.join(twice)}: two joints of one name")
    unmapped = tuple(name for name in dict.fromkeys(figure.joints) if name not in used)
    return JointGuess(source, target, tuple(made), unmapped, tuple(problems))
