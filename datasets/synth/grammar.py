"""Captions of a `Truth`: paraphrases that say every attribute that decides the motion, and nothing else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from motionloom.datasets.synth.truth import Truth

_WHO = ("a person", "a man", "a woman", "someone", "the person", "a figure")
_GENDERED = ("a man", "a woman")
_TIMES = {1: ("once", "one time"), 2: ("twice", "two times"), 3: ("three times",)}
_WORDS = {4: "four", 5: "five"}
_SPEED = {"slowly": ("slowly", "at a slow pace"), "quickly": ("quickly", "fast", "at a fast pace")}

# {s}: limb words, {n}: how often, {v}: speed words; each entry is a list of paraphrases.
_ACTIONS: dict[str, tuple[str, ...]] = {
    "walk forward": ("walks forward{v}", "walks straight ahead{v}", "takes steps forward{v}"),
    "walk backward": ("walks backward{v}", "steps backwards{v}", "walks back{v}"),
    "walk clockwise": ("walks in a clockwise circle{v}", "walks{v} around a circle clockwise"),
    "walk counterclockwise": (
        "walks in a counter-clockwise circle{v}",
        "walks{v} around a circle counterclockwise",
    ),
    "turn left place": ("turns left on the spot", "turns ninety degrees to the left", "turns to the left"),
    "turn right place": (
        "turns right on the spot",
        "turns ninety degrees to the right",
        "turns to the right",
    ),
    "turn left around": ("turns around to the left", "makes a half turn to the left"),
    "turn right around": ("turns around to the right", "makes a half turn to the right"),
    "turn left walking": ("turns left while walking", "walks forward and turns to the left"),
    "turn right walking": ("turns right while walking", "walks forward and turns to the right"),
    "run forward": ("runs forward", "runs straight ahead", "jogs forward fast"),
    "jump up": ("jumps up{n}", "jumps in place{n}", "jumps on the spot{n}"),
    "jump forward": ("jumps forward{n}", "leaps forward{n}"),
    "squat": ("squats{n}{v}", "does a squat{n}{v}", "squats down and stands up{n}{v}"),
    "sit": ("sits down", "takes a seat", "sits down on a chair"),
    "kick": ("kicks with the {s} leg{n}", "kicks forward with the {s} foot{n}", "does a {s} kick{n}"),
    "punch": (
        "punches with the {s} hand{n}",
        "throws a {s} punch{n}",
        "punches forward{n} with the {s} fist",
    ),
    "wave": ("waves with {s}", "waves {s}", "greets by waving {s}"),
    "clap": ("claps{n}", "claps the hands{n}", "claps both hands together{n}"),
    "raise": ("raises {s}", "lifts {s} up overhead", "raises {s} above the head"),
    "reach forward": ("reaches forward with the {s} hand", "stretches the {s} hand out in front"),
    "reach up": ("reaches up with the {s} hand", "reaches for a high shelf with the {s} hand"),
    "reach down": ("reaches down with the {s} hand", "reaches to the floor with the {s} hand"),
    "reach left": ("reaches to the left with the {s} hand", "stretches the {s} hand out to the left"),
    "reach right": ("reaches to the right with the {s} hand", "stretches the {s} hand out to the right"),
    "bow": ("bows{v}", "takes a bow{v}", "bows forward{v}"),
    "dance": (
        "dances to music at {b} beats per minute",
        "dances at {b} bpm",
        "dances to a {t} beat of {b} beats per minute",
    ),
}
_HAND_DOING = {
    "fist": ("making a fist with {h}", "with {h} in a fist"),
    "point": ("pointing the index finger of {h}", "pointing with {h}"),
    "spread": ("spreading the fingers of {h}", "with the fingers of {h} spread"),
    "pinch": ("pinching with {h}", "pinching thumb and index finger of {h}"),
    "wave_fingers": ("wiggling the fingers of {h}", "waving the fingers of {h}"),
}
_FACES = {
    "happy": ("looks happy", "smiles happily", "has a happy face", "is smiling with joy"),
    "sad": ("looks sad", "has a sad face", "frowns sadly", "looks unhappy"),
    "angry": ("looks angry", "has an angry face", "glares with anger", "is angry"),
    "surprised": ("looks surprised", "has a surprised face", "raises the brows in surprise", "is astonished"),
    "neutral": ("looks neutral", "has a neutral face", "shows no emotion", "keeps a calm face"),
}


def body_captions(truth: Truth, rng: np.random.Generator, number: int = 3, hands: bool = True) -> list[str]:
    """`number` different body captions, or as many as there are wordings."""
    found: list[str] = []
    for _ in range(8 * number):
        text = _sentence(truth, rng, hands)
        if text not in found:
            found.append(text)
        if len(found) == number:
            break
    return found


def face_captions(
    truth: Truth, rng: np.random.Generator, number: int = 2, body: Sequence[str] = ()
) -> list[str]:
    """Captions of the face alone, about a person that none of the clip's `body` captions contradicts.

    Any of them may be trained on together: where a body caption says "a woman" no face is a man's, and where
    others of the same clip say "a man" the face is a person's.
    """
    said = {who for who in _GENDERED if any(text.startswith(f"{who} ") for text in body)}
    people = tuple(who for who in _WHO if who not in _GENDERED or said <= {who})
    order = rng.permutation(len(_FACES[truth.face]))[:number]
    return [f"{_pick(rng, people)} {_FACES[truth.face][int(k)]}" for k in order]


def _sentence(truth: Truth, rng: np.random.Generator, hands: bool) -> str:
    key = " ".join(
        word
        for word in (truth.action, truth.direction, truth.style if truth.action == "turn" else None)
        if word is not None
    )
    words = _pick(rng, _ACTIONS[key])
    speed = f" {_pick(rng, _SPEED[truth.speed])}" if truth.speed else ""
    tempo = "slow" if (truth.bpm or 0) < 100 else "moderate" if (truth.bpm or 0) < 125 else "fast"
    text = words.format(v=speed, n=_times(truth.count, rng), s=_limb(truth, rng), b=truth.bpm, t=tempo)
    phrases = _hand_phrases(truth, rng) if hands else []
    return ", ".join([f"{_pick(rng, _WHO)} {text}", *phrases[:1]]) + "".join(f" and {p}" for p in phrases[1:])


def _times(count: int | None, rng: np.random.Generator) -> str:
    if count is None:
        return ""
    if count in _WORDS:
        return f" {_WORDS[count]} times"
    return f" {_pick(rng, _TIMES[count])}"


def _limb(truth: Truth, rng: np.random.Generator) -> str:
    if truth.action == "wave":
        return "both hands" if truth.side == "both" else f"the {truth.side} hand"
    if truth.action == "raise":
        word = _pick(rng, ("arm", "hand"))
        return f"both {word}s" if truth.side == "both" else f"the {truth.side} {word}"
    return truth.side or ""


def _hand_phrases(truth: Truth, rng: np.random.Generator) -> list[str]:
    """What the hands do, unless the action itself already says it."""
    said = {"punch": "fist", "wave": "spread"}.get(truth.action)
    shapes = []
    for name, shape in (("left", truth.left_hand), ("right", truth.right_hand)):
        implied = shape == said and truth.side in (name, "both")
        if shape != "relaxed" and not implied:
            shapes.append((name, shape))
    if len(shapes) == 2 and shapes[0][1] == shapes[1][1]:
        doing = _pick(rng, _HAND_DOING[shapes[0][1]][:1])
        plural = doing.replace("a fist with", "fists with").replace("index finger", "index fingers")
        return [plural.format(h="both hands")]
    return [_pick(rng, _HAND_DOING[shape]).format(h=f"the {name} hand") for name, shape in shapes]


def _pick(rng: np.random.Generator, options: tuple[str, ...]) -> str:
    return options[int(rng.integers(len(options)))]
