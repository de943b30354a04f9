"""Choreography: the body, hands and face of somebody who dances to a song, every pose on a beat.

A dance is made of phrases of two bars, and a break is a phrase of its own. Each phrase draws a move of the
legs, a pair of arm poses and how the arms share it (`genres.py`), so that it is unlike the one before; the
poses alternate from beat to beat. Between two beats the body eases from pose to pose with a minimum-jerk
curve, which has no speed at its ends: every beat is a minimum of the body's speed, which is what Beat Align
looks for (UDE section 4.3).

How large all of it is follows the energy of the music. In a break the body holds a pose, with a small nod on
the beats; the first beat after it is an accent. The hands and the face are at their strongest on the first
beat of a bar. Sizes are those of recorded dances, in which the joints move at 0.3 to 1 metre a second, a
foot is lifted about half of the time and the root sways by 6 to 18 centimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from motionloom.datasets.actions.dances import Style
from motionloom.datasets.synth.actions.arms import Hold, play
from motionloom.datasets.synth.actions.maths import Array, ease, keys
from motionloom.datasets.synth.actions.pose import Track
from motionloom.datasets.synth.hands_and_face import express_with, grip_hand
from motionloom.datasets.synth.music.genres import (
    ACCENTS,
    ARM_WAYS,
    FREEZES,
    LEGS,
    LEGS_OF,
    MORE_ARMS,
    QUIET_LEGS,
    ArmPair,
    ArmPose,
)
from motionloom.datasets.synth.music.song import Song

_T = TypeVar("_T")
_BODY: dict[Style, tuple[float, float, float, float, float]] = {
    # Metres of a step, metres aside and down, radians of the pelvis' roll and of the spine's twist.
    "step": (0.26, 0.0, 0.05, 0.05, 0.2),
    "bounce": (0.09, 0.0, 0.13, 0.0, 0.1),
    "sway": (0.09, 0.1, 0.045, 0.09, 0.25),
}
_DEEPEST = 0.17
"""Metres that a dancer goes down at most: below is a squat."""
_WIDE = 0.22
"""Metres that a foot is set aside for the accent after a break."""
_TURN = 0.45
"""Radians of a turn to one side."""
_LIFT, _SHUFFLE = 0.09, 0.024
"""Metres that a foot is lifted on its way, by dancers who step and by the others."""
_KNEE = 0.16
"""Metres that a foot is lifted below a lifted knee."""
_SWING = 0.12
"""Share of a beat for which a foot is lifted before it goes anywhere, and again before it stands."""
_SLOW = 0.18
"""Metres per second below which a foot may shuffle; a quicker one is lifted high."""
_QUIET, _LOUD = 0.45, 0.8
"""Energies of the music below which feet stay nearly still, and above which dancers turn round."""
_EVEN = 0.75
"""Energy of the music that is danced at plain size."""
_OWN_ARMS = 0.6
"""Share of the phrases that have the genre's own arms."""
_SHORT_BEAT = 0.42
"""Seconds of a beat below which moves become smaller, for nobody is quick enough."""


@dataclass(frozen=True, eq=False)
class _Phrase:
    """Two bars of a dance, or what a section leaves of them."""

    legs: str
    arms: ArmPair
    """On the even and the odd beats; of a break what the left and the right arm hold."""
    way: str
    """A name of `ARM_WAYS`, or freeze."""
    lean: float
    """Radians the spine leans forward."""
    pop: float
    """Radians it leans further forward on the even beats."""


@dataclass(frozen=True)
class _Plan:
    """All beats of a clip, from the beginning of the section before it on, N of them."""

    song: Song
    numbers: list[int]
    seconds: Array
    """[N] counted from the start of the clip."""
    size: Array
    """[N] of the moves, 1 is plain; 0 in breaks."""
    still: Array
    """[N] 1 in breaks, 0 elsewhere."""
    accent: Array
    """[N] 1 on the first beat after a break, 0 elsewhere."""
    lead: int
    """Foot that begins, 0 or 1."""
    phrases: list[_Phrase]
    """[N] the phrase that each beat belongs to."""

    @property
    def odd(self) -> Array:
        """[N] 1 on odd beats of the song, 0 on even ones."""
        return np.asarray(self.numbers, dtype=np.float64) % 2


def choreograph(song: Song, start: float, frames: int, fps: float, rng: np.random.Generator) -> Track:
    """A dance of `frames` frames to the music from `start` seconds of a song on."""
    track = Track.standing(frames / fps, fps, rng, width=rng.uniform(0.0, 0.05))
    plan = _plan(song, start, start + frames / fps, rng)
    heading = _move_feet(track, plan)
    _move_body(track, plan, heading, rng)
    for hand in (0, 1):
        _move_arm(track, plan, hand)
    track.lower_to_reach(0.5 / fps)
    return track


def dancing_hands(song: Song, start: float, t: Array, rng: np.random.Generator) -> Array:
    """Finger rotations [2, T, 15, 3, 3]: the genre's hand shape, loosened in the second half of each bar, and
    in breaks nearly relaxed."""
    grip = np.minimum(_accents(song, start, t, 1.0, 0.7), 1.0)
    return np.stack([grip_hand(song.style.hand, t, grip, rng) for _ in (0, 1)])


def dancing_face(song: Song, start: float, t: Array, rng: np.random.Generator) -> Array:
    """Expression values [T, 50]: the genre's emotion, lighting up where a bar begins, faint in breaks."""
    return express_with(song.style.face, t, rng.uniform(0.9, 1.1) * _accents(song, start, t, 1.1, 0.5), rng)


def _accents(song: Song, start: float, t: Array, high: float, low: float) -> Array:
    """A curve [T]: `high` on the first beat of each bar, falling to `low` in its middle, and back; less where
    the music is quiet, and least in breaks."""
    halves = np.arange(
        2 * (song.beat_number(start) // song.meter - 1),
        2 * (song.beat_number(start + float(t[-1])) // song.meter + 2),
    )
    numbers = halves * song.meter / 2
    energy = np.array([song.section_of(int(number)).energy for number in numbers])
    strength = np.where(energy > 0, 0.7 + 0.4 * np.minimum(energy, _EVEN), 0.15)
    return keys(t + start, song.times(numbers), strength * np.where(halves % 2 == 0, high, low))


def _plan(song: Song, start: float, end: float, rng: np.random.Generator) -> _Plan:
    first = song.beat_number(start) - 1
    first -= first % song.meter
    while first > 0 and song.section_of(first - 1) is song.section_of(first):
        first -= song.meter  # phrases are counted from where the section begins
    numbers = list(range(first, song.beat_number(end) + 3))
    energy = np.array([song.section_of(number).energy for number in numbers])
    still = energy == 0
    accent = ~still & np.concatenate([[False], still[:-1]])
    dancer = rng.uniform(0.87, 1.13) * min(1.0, song.beat / _SHORT_BEAT)
    size = dancer * np.maximum((energy / _EVEN) ** 1.3, 0.35) * np.where(accent, 1.4, 1.0)
    return _Plan(
        song=song,
        numbers=numbers,
        seconds=song.times(numbers) - start,
        size=np.where(still, 0.0, size),
        still=still.astype(np.float64),
        accent=accent.astype(np.float64),
        lead=int(rng.integers(2)),
        phrases=_phrases(song, numbers, rng),
    )


def _phrases(song: Song, numbers: list[int], rng: np.random.Generator) -> list[_Phrase]:
    """The phrase of each beat. Phrases end after two bars of their section, and with it."""
    out: list[_Phrase] = []
    for number in numbers:
        section = song.section_of(number)
        energy = section.energy
        beats = sum(phrase is out[-1] for phrase in out)
        same = bool(out) and section is song.section_of(number - 1)
        if same and (energy == 0 or beats < 2 * song.meter):
            out.append(out[-1])
            continue
        phrase = _draw_phrase(song, number, energy, rng)
        # Of legs, arms and how the arms share them two differ from the phrase before.
        while out and sum(getattr(phrase, of) != getattr(out[-1], of) for of in ("legs", "arms", "way")) < 2:
            phrase = _draw_phrase(song, number, energy, rng)
        out.append(phrase)
    return out


def _draw_phrase(song: Song, number: int, energy: float, rng: np.random.Generator) -> _Phrase:
    genre = song.style
    if energy == 0:
        legs = "stand"
        arms = _one_of(FREEZES[song.genre], rng)
        way = "freeze"
    else:
        weights = dict(QUIET_LEGS[genre.style] if energy < _QUIET else LEGS_OF[genre.style])
        if energy > _LOUD:
            weights["round"] = 0.1 * sum(weights.values())
        chances = np.array(list(weights.values()))
        legs = list(weights)[int(rng.choice(len(chances), p=chances / chances.sum()))]
        own = rng.random() < _OWN_ARMS
        arms = genre.arms[song.section_of(number).kind] if own else _one_of(MORE_ARMS[song.genre], rng)
        way = _one_of(ARM_WAYS, rng)
    return _Phrase(legs, arms, way, float(rng.normal(0.0, 0.05)), float(rng.uniform(-0.06, 0.1)))


def _one_of(choices: Sequence[_T], rng: np.random.Generator) -> _T:
    return choices[int(rng.integers(len(choices)))]


# ---- legs


def _move_feet(track: Track, plan: _Plan) -> Array:
    """Put the feet where the phrases want them; returns where the body stands: x, z, heading [T, 3].

    A foot is on its place at each beat. On the way it goes up before it goes anywhere, and down after it.
    """
    places, lifts = _places(plan)
    t = track.t
    beats = plan.seconds
    index = np.clip(np.searchsorted(beats, t, side="right") - 1, 0, len(beats) - 2)
    phase = (t - beats[index]) / (beats[index + 1] - beats[index])
    away = ease((phase - _SWING) / (1 - 2 * _SWING))
    up = ease(phase / 0.4) * ease((1 - phase) / 0.4)
    body = keys(t, beats, places[:, :, [0, 1, 3]].mean(0))
    for foot in (0, 1):
        from_ = places[foot][index]
        to = places[foot][index + 1]
        aside, forward, _, turn = (from_ + away[:, None] * (to - from_)).T
        lift = lifts[foot][index + 1] * up
        out = track.ball[foot, :, 0].copy()
        ahead = track.ball[foot, :, 2].copy()
        track.ball[foot, :, 0] = aside + out * np.cos(turn) + ahead * np.sin(turn)
        track.ball[foot, :, 2] = forward - out * np.sin(turn) + ahead * np.cos(turn)
        raised = keys(t, beats, places[foot, :, 2])
        track.ball[foot, :, 1] += lift + raised
        track.foot_pitch[foot] += 4.0 * lift + 2.5 * raised
        track.foot_yaw[foot] += turn
    return body


def _places(plan: _Plan) -> tuple[Array, Array]:
    """Return the place of each foot on each beat, off its first: x, z, height, heading [2, N, 4], and its
    lift on the way there [2, N]."""
    style = plan.song.style.style
    places = np.zeros((2, len(plan.numbers), 4))
    lifts = np.zeros((2, len(plan.numbers)))
    base = 0.0
    first = 0
    for k, phrase in enumerate(plan.phrases):
        before = places[:, k - 1] if k else places[:, 0]
        if k and phrase is not plan.phrases[k - 1]:
            base += _rounds(plan, k - first, 0)[1] if plan.phrases[k - 1].legs == "round" else 0.0
            first = k
        places[:, k] = before * [1, 1, 0, 1] if plan.still[k] else _targets(plan, k, k - first, base)
        if not k:
            continue
        moved = np.abs(places[:, k] - before).max(-1) > 1e-6
        if moved.all():
            # One foot goes, the one that is in the air or has the longer way; the other waits for its turn.
            ways = np.abs(places[:, k] - before).sum(-1) + 9.0 * (before[:, 2] > 0)
            other = int(np.argmin(ways))
            places[other, k] = before[other]
            moved[other] = False
        away = np.linalg.norm((places[:, k] - before) * [1, 1, 0, 0.12], axis=-1)
        # Quick feet are lifted high, or they would slide; slow ones may shuffle.
        far = away > _SLOW * (plan.seconds[k] - plan.seconds[k - 1])
        grounded = (before[:, 2] == 0) & (places[:, k, 2] == 0)
        high = _LIFT * np.clip(0.5 + 0.5 * plan.size[k], 0.6, 1.1)
        lifts[:, k] = np.where(moved & grounded, np.where(far | (style == "step"), high, _SHUFFLE), 0.0)
    return places, lifts


def _targets(plan: _Plan, k: int, beat: int, base: float) -> Array:
    """Places [2, 4] of both feet on beat `k`, which is `beat` of its phrase, for a dancer headed `base`."""
    phrase = plan.phrases[k]
    size = plan.size[k]
    step = size * _BODY[plan.song.style.style][0]
    if plan.song.style.style != "step":
        step = min(step, 0.9 * _SLOW * plan.song.beat)
    mirrored = (beat // 4 + plan.lead) % 2
    sign = -1.0 if mirrored else 1.0
    if phrase.legs == "round":
        moves = np.zeros((2, 4))
        turns = np.array(_rounds(plan, beat, plan.lead))
    else:
        move = LEGS[phrase.legs]
        moves = np.array([move.left[beat % 4], move.right[beat % 4]]) * [sign, 1.0, 1.0, sign]
        moves = moves[::-1] if mirrored else moves
        turns = _TURN * min(size, 1.0) * moves[:, 3]
    if plan.accent[k]:
        moves[mirrored, 0] = sign * _WIDE / step
    heading = base + turns
    aside, forward = step * moves[:, :2].T
    x = aside * np.cos(heading) + forward * np.sin(heading)
    z = forward * np.cos(heading) - aside * np.sin(heading)
    return np.stack([x, z, _KNEE * size * moves[:, 2], heading], axis=-1)


def _rounds(plan: _Plan, beat: int, lead: int) -> tuple[float, float]:
    """Headings of the left and the right foot on a beat of a phrase that turns round."""
    sign = -1.0 if plan.lead else 1.0
    turn = sign * 2 * np.pi / plan.song.meter
    first = (beat + 1) // 2 * turn
    second = beat // 2 * turn
    return (second, first) if lead else (first, second)


# ---- body and arms


def _move_body(track: Track, plan: _Plan, body: Array, rng: np.random.Generator) -> None:
    """Move root, spine and head over the feet; `body` is what `_move_feet` returns."""
    _, aside, down, roll, twist = _BODY[plan.song.style.style]
    size = plan.size
    even = 1.0 - plan.odd
    side = size * (2.0 * even - 1.0)

    def keyed(values: Array) -> Array:
        return keys(track.t, plan.seconds, values)

    heading = body[:, 2]
    swayed = keyed(aside * side)
    track.yaw += heading
    track.root[:, 0] += body[:, 0] + swayed * np.cos(heading)
    track.root[:, 2] += body[:, 1] - swayed * np.sin(heading)
    dips = np.maximum(size, 0.6) * down * (even + 0.4 * plan.accent)
    track.root[:, 1] -= keyed(
        np.where(plan.still > 0, 0.04 + 0.012 * even, 0.03 + np.minimum(dips, _DEEPEST))
    )
    lean, pop = (np.array([getattr(phrase, name) for phrase in plan.phrases]) for name in ("lean", "pop"))
    track.pelvis[:, 2] += keyed(roll * side)
    track.spine[:, 0] += keyed(lean + size * pop * even + 0.08 * plan.still)
    track.spine[:, 1] += keyed(twist * side)
    track.spine[:, 2] -= keyed(2.0 * roll * side)
    # The head nods deeper where a bar begins, and hangs a little in a break.
    nods = np.where(np.array(plan.numbers) % plan.song.meter == 0, 1.0, 0.6 * even)
    track.head[:, 0] += keyed(rng.uniform(0.12, 0.2) * size * nods + plan.still * (0.12 + 0.05 * even))
    track.knee_out += keyed(0.1 * even * np.minimum(size, 1.2))
    if plan.song.style.style != "step":
        for foot, free in enumerate((plan.odd, even)):
            track.foot_pitch[foot] += keyed(0.2 * size * free)


def _move_arm(track: Track, plan: _Plan, hand: int) -> None:
    holds: list[Hold] = []
    first = 0
    for k, phrase in enumerate(plan.phrases):
        first = first if k and phrase is plan.phrases[k - 1] else k
        if plan.still[k]:
            pose = phrase.arms[hand]
        elif plan.accent[k]:
            pose = ACCENTS[plan.song.genre]
        else:
            share = float(plan.odd[k])
            if phrase.way == "opposite" and hand != plan.lead:
                share = 1.0 - share
            elif phrase.way == "in turn" and ((k - first) // 2 + hand + plan.lead) % 2:
                share = 0.5
            pose = _between(phrase.arms, share, float(plan.size[k]))
        holds.append((float(plan.seconds[k]), *pose))
    play(track, hand, holds)


def _between(pair: ArmPair, share: float, size: float) -> ArmPose:
    """A pose `share` of the way from the first of a pair to the second, which both are as far from their
    middle as `size` says; who dances large holds the arms higher too."""
    (from_, near, bend), (to, far, other) = pair
    share = 0.5 + min(size, 1.3) * (share - 0.5)
    x, y, z = (a + share * (b - a) for a, b in zip(from_, to, strict=True))
    u, v, w = (a + share * (b - a) for a, b in zip(bend, other, strict=True))
    return (x, y + 0.2 * max(size - 1.0, 0.0), z), min(max(near + share * (far - near), 0.4), 0.97), (u, v, w)
