"""Recognise what a motion does from its joints alone, to prove captions true and to judge generated motion.

`agrees` recognises the action by a cascade of physical signs (who flies, who travels, who turns, who sinks,
whose foot or hand leaves its place) and compares with a truth record, reading each attribute as the *claimed*
action defines it, so one wrong action does not hide a right limb. `find_mismatch` compares with requests:
truth records that state only what was asked for.

Thresholds were set between the measured values of the synthetic source's clips (`datasets/synth`), of which
99 % are recognised in every attribute (`tests/datasets/synth/test_synth.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.actions.dances import Record, measure_dance
from motionloom.datasets.actions.hands import SIDES, hand_shape
from motionloom.datasets.actions.signals import BALLS, Signals, rise_time, signals_of, tempo
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.expressions import emotion_of
from motionloom.datasets.motion.canonical import runs

CIRCLE = 4.0
"""Net turn (radians) of a walk or a run from which it is a circle."""
TURN = 0.6
WALKED = 0.3
"""Metres from which somebody has gone somewhere."""
LYING = 0.62
"""Metres that the root falls of somebody who lies down, at least."""
ASIDE = 0.22
"""Lean (radians) to a side from which somebody stretches there."""
UPRIGHT = 0.055
"""Change of lean to the side (radians) below which somebody stands upright all the time; twice forward."""
_LENGTH = 1.0
"""Seconds that a motion may be shorter or longer than was said."""
_SHAPES = {
    "fist": "a fist", "point": "pointing", "spread": "open", "pinch": "pinching", "wave_fingers": "wiggling",
}  # fmt: skip
_NOUNS = {"lie": "lying down", "sit": "sitting"}
_ATTRIBUTES = ("direction", "side", "count", "speed", "bpm")


def action_of(joints: NDArray[np.floating], fps: float) -> str:
    """Return the action that joints [T, N >= 22, 3] (metres, Y up) show, taken as a single one."""
    return _action(signals_of(joints, fps))


def agrees(
    truth: Mapping[str, Any],
    joints: NDArray[np.floating],
    face: NDArray[np.floating] | None = None,
    fps: float = 30.0,
) -> dict[str, bool]:
    """Return for each attribute of a truth record that applies whether the motion shows it.

    truth is `ClipMeta.truth`; joints [T, 22 or 52, 3]; face [T, 50] or None (the face is then not judged).
    A tempo agrees within 5 %. Of a dance to a song style and genre are judged too (`measure_dance`).
    """
    if "action" not in truth:
        raise UserError("truth has no 'action'; judge only clips of the synthetic source")
    claimed = str(truth["action"])
    if claimed == "then":
        return _agrees_in_turn(truth, joints, face, fps)
    signals = signals_of(joints, fps)
    out = {"action": _action(signals) == claimed}
    found = _attributes(signals, claimed)
    for name in _ATTRIBUTES:
        wanted = truth.get(name)
        if wanted is None and not (name == "speed" and name in found and "speed" in truth):
            continue
        got = found.get(name)
        if name == "bpm":
            out[name] = got is not None and wanted is not None and abs(got - wanted) <= 0.05 * wanted
        else:
            out[name] = bool(got == wanted)
    if truth.get("genre") is not None:
        danced = measure_dance(joints, fps)
        out |= {"style": danced.style == truth.get("style"), "genre": danced.genre == truth["genre"]}
    if joints.shape[1] >= 52:
        for side, name in enumerate(SIDES):
            if truth.get(f"{name}_hand") is not None:
                out[f"{name}_hand"] = hand_shape(joints, side, fps) == truth[f"{name}_hand"]
    return out | _face(truth, face)


def actions_of(truth: Mapping[str, Any] | None) -> tuple[str, ...]:
    """Return the actions of a truth record in their order; none where it states none."""
    if truth is None or "action" not in truth:
        return ()
    return tuple(part["action"] for part in truth.get("parts") or [truth])


def find_mismatch(requests: Sequence[Record], joints: NDArray[np.floating], fps: float) -> str | None:
    """Return in words what joints [T, N >= 22, 3], T >= 4, do not show of a request; None where all is shown.

    Of several requests, which a caption may mean, one has to be shown.
    """
    shown = []
    signals = signals_of(joints, fps)
    for request in requests:  # by their actions alone, whatever the attributes are
        bare = {"action": request["action"], "parts": [{"action": act} for act in actions_of(request)]}
        act = _action(signals)
        walks = request["action"] == "walk" and _moved(signals) > WALKED and act == "turn"
        alike = {request["action"], act}  # but for an upright body, or how far both arms go up
        stretches = alike in ({"reach", "point"}, {"raise", "stretch"})
        if walks or stretches or agrees(bare, joints, None, fps)["action"]:  # who turns on the way walks
            shown.append(request)
    if not shown:
        wanted = (" and then ".join(_NOUNS.get(act, act) for act in actions_of(one)) for one in requests)
        return f"the motion shows no {' nor '.join(wanted)}"
    asked = shown[0]
    if abs(len(joints) / fps - asked.get("seconds", len(joints) / fps)) > _LENGTH:
        return f"it lasts {len(joints) / fps:.1f} s, not {asked['seconds']}"
    for side, name in enumerate(SIDES):
        meant = asked.get(f"{name}_hand")
        if not meant or joints.shape[1] < 52:
            continue
        shape = hand_shape(joints, side, fps)
        if shape != meant:
            return f"the {name} hand is {_SHAPES.get(shape, shape)}, not {_SHAPES[meant]}"
    if len(actions_of(asked)) > 1:
        # Where the first ends is not known: something is wrong that is so wherever the motion is cut.
        held = agrees(asked, joints, None, fps)
        wrong = [name for name, holds in held.items() if not holds]
        return f"the {wrong[0]} of one of both is another" if wrong else None
    seen = _attributes(signals, asked["action"])
    for name in seen:  # of what this action does not define, nothing is known
        if asked.get(name) is not None and seen[name] != asked[name]:
            return f"the {name} is {seen[name] or 'another'}, not {asked[name]}"
    return None


def _face(truth: Mapping[str, Any], face: NDArray[np.floating] | None) -> dict[str, bool]:
    return {} if face is None or truth.get("face") is None else {"face": emotion_of(face) == truth["face"]}


def _agrees_in_turn(
    truth: Mapping[str, Any], joints: NDArray[np.floating], face: NDArray[np.floating] | None, fps: float
) -> dict[str, bool]:
    """Return the verdicts on both parts, cut where most of them hold."""
    found: list[dict[str, bool]] = []
    for cut in _cuts(len(joints), fps):
        halves = (joints[:cut, :22], joints[cut:, :22])
        verdicts = [agrees(part, half, None, fps) for part, half in zip(truth["parts"], halves, strict=True)]
        names = dict.fromkeys(name for verdict in verdicts for name in verdict)
        found.append({name: all(verdict.get(name, True) for verdict in verdicts) for name in names})
    return max(found, key=lambda one: (one["action"], sum(one.values()))) | _face(truth, face)


def _cuts(frames: int, fps: float) -> range:
    """Return the frames at which a motion of two actions may change from one to the other."""
    least = min(max(4, round(fps)), frames // 2)
    return range(least, frames - least + 1, max(1, round(fps / 10)))


def _action(s: Signals) -> str:
    moved = _moved(s)
    turned = abs(_turned(s))
    # From signs that no other action shows to those that several share, so that each test may assume that
    # the ones before it failed. First who is on the floor.
    if np.percentile(s.drop, 10) > 0.3 and np.median(s.trunk) > 0.9:
        return "crawl"
    if s.drop.max() > LYING:
        return "lie"
    # Then who leaves the floor: runners fly too, so their pace is asked before their hops and jumps. No hop
    # lifts the other foot to a kick's height, and who kicks may leave the floor a little.
    flights = len(_flights(s))
    if _pace(s) > 1.6 and (flights >= 2 or s.balls.max() > 0.13):
        return "run"
    if flights and max(_hops(s)) and s.balls.max() < 0.55:
        return "hop"
    if flights and s.drop.min() < -0.05:
        return "jump"
    # A kick lifts a foot as high as no walker does.
    if moved > WALKED and s.balls.max() < 0.4:
        return "turn" if TURN < turned < CIRCLE else "walk"
    if turned > TURN:
        return "turn"
    # Who is seated all the time may use the hands.
    if s.drop.min() > 0.3 and s.wrists[..., 1].max() > -0.3:
        return _arm_action(s)
    # Whoever sinks reaches down where a hand is near the floor, and sits where the hips are behind the feet.
    if s.drop.max() > 0.23:
        low = int(np.argmax(s.drop))
        if s.wrist_height[:, low].min() < 0.42 and s.trunk[low] > 0.6:
            return "reach"
        return "sit" if s.behind[low] > 0.22 else "squat"
    if s.balls.max() > 0.4:
        return "kick"
    if s.peaks(s.drop, 0.018) >= 3:
        return "dance"
    if s.trunk.max() > 0.5:
        return "bow"
    return _arm_action(s)


def _arm_action(s: Signals) -> str:
    waves = [_waves(s, side) for side in (0, 1)]
    tops = s.wrists[:, :, 1].max(1)
    if max(waves) >= 3:
        return "wave"
    if tops.min() > 0.35 and (np.abs(s.aside).max() > ASIDE or s.drop.min() < -0.02):
        return "stretch"
    if tops.max() > 0.6:
        hand = int(np.argmax(tops))
        top = int(np.argmax(s.wrists[hand, :, 1]))
        return "raise" if s.wrists[hand, top, 2] < 0.28 else _reach_or_point(s)
    # A punch is a reach forward that is not held.
    hand, direction = _reach(s)
    forward = s.wrists[hand, :, 2]
    if direction == "forward" and forward.max() > 0.78 and s.longest(forward > 0.85 * forward.max()) < 0.5:
        return "punch"
    return "clap" if _claps(s) >= 1 else _reach_or_point(s)


def _reach_or_point(s: Signals) -> str:
    """Return `point` where the body stays upright and the feet flat, else `reach`."""
    upright = np.ptp(s.trunk) < 2 * UPRIGHT and np.ptp(s.aside) < UPRIGHT
    return "point" if upright and s.drop.min() > -0.012 else "reach"


def _attributes(s: Signals, action: str) -> Record:
    """Return direction, side, count, speed or tempo as `action` defines them."""
    if action in ("walk", "run"):
        backward = s.travel[-1] < 0
        turned = _turned(s)
        way = "backward" if backward else "forward"
        aside = _aside(s)
        if abs(aside) > abs(s.travel[-1]):
            way = "sideways"
        if abs(turned) > CIRCLE:
            way = "counterclockwise" if turned > 0 else "clockwise"
        found = {"direction": way, "path": _path(s), "side": SIDES[0] if aside > 0 else SIDES[1]}
        if action == "walk":
            found["speed"] = _speed(_pace(s), *((0.57, 0.98) if backward else (0.78, 1.38)))
        return found
    if action == "turn":
        return {"direction": "left" if _turned(s) > 0 else "right"}
    if action == "jump":
        return {"direction": "forward" if s.travel[-1] > 0.15 else "up", "count": len(_flights(s))}
    if action == "squat":
        fall = rise_time(s.drop, s.fps)
        return {"count": s.peaks(s.drop, 0.15), "speed": _speed(1 / fall, 1 / 0.93, 1 / 0.54)}
    if action == "bow":
        return {"speed": _speed(1 / rise_time(s.trunk, s.fps), 1 / 1.14, 1 / 0.68)}
    if action == "kick":
        leg = int(np.argmax(s.balls.max(1)))
        return {"side": SIDES[leg], "count": s.peaks(s.balls[leg], 0.4), "direction": _kicked(s, leg)}
    if action == "punch":
        hand = int(np.argmax(s.wrists[:, :, 2].max(1)))
        return {"side": SIDES[hand], "count": s.peaks(s.wrists[hand, :, 2], 0.15, 0.7)}
    if action == "wave":
        return {"side": _both(np.array([_waves(s, side) >= 3 for side in (0, 1)]))}
    if action == "raise":
        return {"side": _both(s.wrists[:, :, 1].max(1) > 0.6)}
    if action == "clap":
        return {"count": _claps(s)}
    if action == "hop":
        hops = _hops(s)
        leg = int(np.argmax(hops))
        return {"side": SIDES[leg], "count": hops[leg]}
    if action == "stretch":
        lean = float(s.aside[int(np.argmax(np.abs(s.aside)))])
        return {"direction": "up" if abs(lean) < ASIDE else SIDES[0] if lean > 0 else SIDES[1]}
    if action == "crawl":
        return {"direction": "forward" if s.travel[-1] > 0 else "backward"}
    if action in ("reach", "point"):
        hand, direction = _reach(s)
        return {"side": SIDES[hand], "direction": direction}
    return {"bpm": tempo(s)} if action == "dance" else {}


def _moved(s: Signals) -> float:
    return max(abs(float(s.travel[-1])), abs(_aside(s)))


def _aside(s: Signals) -> float:
    """Metres that the feet have gone to the left of the heading."""
    step = np.diff(s.joints[:, BALLS].mean(1)[:, [0, 2]], axis=0)
    return float((step * _left(s)[1:]).sum())


def _left(s: Signals) -> NDArray[np.float64]:
    return np.stack([np.cos(s.heading), -np.sin(s.heading)], axis=-1)


def _kicked(s: Signals, leg: int) -> str:
    """Where a foot goes, from its hip, at the height of the kick."""
    top = int(np.argmax(s.balls[leg]))
    away = (s.joints[top, BALLS[leg]] - s.joints[top, 1 + leg])[[0, 2]]
    left = _left(s)[top]
    forward = float(away @ (-left[1], left[0]))
    if abs(float(away @ left)) > abs(forward):
        return "sideways"
    return "forward" if forward > 0 else "backward"


def _reach(s: Signals) -> tuple[int, str]:
    """The hand that stretches furthest from the body, and where it goes."""
    if s.drop.max() > 0.2 and s.trunk.max() > 0.6:
        return int(np.argmin(s.wrist_height.min(1))), "down"
    out, up, forward = (s.wrists[:, :, k].max(1) for k in range(3))
    hand = int(np.argmax(np.maximum(np.maximum(out, up), forward)))
    if up[hand] > 0.5:
        return hand, "up"
    return hand, SIDES[hand] if out[hand] > forward[hand] else "forward"


def _waves(s: Signals, side: int) -> int:
    """Return the number of times that a raised hand turns back between left and right."""
    from scipy.signal import find_peaks

    raised = s.wrists[side, :, 1] > 0.12
    if not raised.any():
        return 0
    start, end = max(runs(raised), key=lambda run: run[1] - run[0])
    aside = s.wrists[side, start:end, 0]
    return sum(len(find_peaks(sign * aside, prominence=0.1)[0]) for sign in (1, -1))


def _claps(s: Signals) -> int:
    return s.peaks(-s.apart, 0.1, -0.19)


def _flights(s: Signals) -> list[tuple[int, int]]:
    """Runs of frames in which both feet are off the floor."""
    return [r for r in runs(s.balls.min(0) > 0.04) if (r[1] - r[0]) / s.fps >= 0.06]


def _hops(s: Signals) -> list[int]:
    """Flights of each leg while the other foot stays up from before to after them."""
    out = []
    for leg in (0, 1):
        found = 0
        for start, end in runs(s.balls[1 - leg] > 0.08):
            inside = [f for f in _flights(s) if f[0] > start + 0.12 * s.fps and f[1] < end]
            found = max(found, len(inside))
        out.append(found)
    return out


def _turned(s: Signals) -> float:
    end = max(1, len(s.heading) // 12)
    return float(s.heading[-end:].mean() - s.heading[:end].mean())


def _path(s: Signals) -> str | None:
    return "a circle" if abs(_turned(s)) > CIRCLE else None


def _pace(s: Signals) -> float:
    return float(np.percentile(np.abs(s.speed), 75))


def _speed(value: float, slow: float, quick: float) -> str | None:
    return "slowly" if value < slow else "quickly" if value > quick else None


def _both(hands: NDArray[np.bool_]) -> str | None:
    return "both" if hands.all() else SIDES[int(np.argmax(hands))] if hands.any() else None
