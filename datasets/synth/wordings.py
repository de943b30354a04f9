"""Captions in many words: sentences of several forms from tables of verbs, for models that shall take more.

`grammar.py` says each attribute in two or three ways, always in the same form. A model that learns from it
knows those words. Here a `Truth` is said in any of a dozen verbs, as a statement, a request, a heading or
with the hands first, and still says every attribute that decides the motion and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from motionloom.datasets.schema import Config
from motionloom.datasets.synth.truth import Truth

_PLURAL = ("they",)
_OBJECTS = {"he": "him", "she": "her", "they": "them"}


class Words(Config):
    """`wordings.json`: phrases by what they say. A verb stands before the bar, what follows it behind."""

    note: str
    who: tuple[str, ...]
    actions: dict[str, tuple[str, ...]]
    times: dict[int, tuple[str, ...]]
    speed: dict[str, tuple[str, ...]]
    hands: dict[str, tuple[str, ...]]
    faces: dict[str, tuple[str, ...]]
    irregular: dict[str, tuple[str, str]]
    """Verb -> its forms in the third person and in -ing."""


@cache
def words() -> Words:
    """The table, read once."""
    return Words.load_json(Path(__file__).with_suffix(".json"))


def many_body_captions(truth: Truth, rng: np.random.Generator, number: int, hands: bool) -> list[str]:
    """`number` different captions of the body, or as many as come up."""
    return _different(lambda: _body(truth, rng, hands), number)


def many_face_captions(truth: Truth, rng: np.random.Generator, number: int = 2) -> list[str]:
    """Captions of the face alone. They name nobody in particular, so no body caption can contradict them."""
    who = ("a person", "the person", "someone", "a figure", "a human", "this person", "an individual")
    return _different(
        lambda: _written(f"{_pick(rng, who)} {_third(_pick(rng, words().faces[truth.face]))}", rng), number
    )


def _different(make: Callable[[], str], number: int) -> list[str]:
    found: list[str] = []
    for _ in range(8 * number):
        text = make()
        if text not in found:
            found.append(text)
        if len(found) == number:
            break
    return found


def _body(truth: Truth, rng: np.random.Generator, hands: bool) -> str:
    style = truth.style if truth.action == "turn" else None
    key = " ".join(word for word in (truth.action, truth.direction, style) if word is not None)
    said = _pick(rng, words().actions[key]).format(
        s=truth.side,
        h=_limb(truth, rng),
        n=f" {_pick(rng, words().times[truth.count])}" if truth.count else "",
        v=f" {_pick(rng, words().speed[truth.speed])}" if truth.speed else "",
        b=truth.bpm,
    )
    form, who = int(rng.integers(8)), _pick(rng, words().who)
    if form < 3:
        text = f"{who} {_third(said, who)}"
    elif form < 5:
        text = f"{who} {'are' if who in _PLURAL else 'is'} {_gerund(said)}"
    elif form == 5:
        text = _gerund(said)
    elif form == 6:
        text = said.replace("|", "")
    else:
        seen = _pick(rng, ("this is", "we see", "one can see", "watch"))
        text = f"{seen} {_OBJECTS.get(who, who)} {_gerund(said)}"
    doing = _hands(truth, rng) if hands else []
    if not doing:
        return _written(text, rng)
    together = _pick(rng, (" and ", ", ")).join(doing)
    if rng.random() < 0.25:
        return _written(f"{together}, {text}", rng)
    return _written(f"{text}, {together}", rng)


def _hands(truth: Truth, rng: np.random.Generator) -> list[str]:
    """What the hands do, unless the action itself already says it."""
    said = {"punch": "fist", "wave": "spread"}.get(truth.action)
    shapes = [
        (name, shape)
        for name, shape in (("left", truth.left_hand), ("right", truth.right_hand))
        if shape != "relaxed" and not (shape == said and truth.side in (name, "both"))
    ]
    if len(shapes) == 2 and shapes[0][1] == shapes[1][1]:
        doing = _pick(rng, words().hands[shapes[0][1]][:2])
        plural = (
            doing.replace("a fist", "fists")
            .replace("index finger", "index fingers")
            .replace("in fists", "in a fist")
        )
        return [plural.format(h=_pick(rng, ("both hands", "each hand", "the left and the right hand")))]
    return [_pick(rng, words().hands[shape]).format(h=f"the {name} hand") for name, shape in shapes]


def _limb(truth: Truth, rng: np.random.Generator) -> str:
    word = "hand" if truth.action == "wave" else _pick(rng, ("arm", "hand"))
    if truth.side == "both":
        return _pick(rng, (f"both {word}s", f"both of the {word}s", f"the two {word}s"))
    return f"the {truth.side} {word}"


def _third(phrase: str, who: str = "") -> str:
    """A phrase with its verb as "he" or "they" take it."""
    verb, _, rest = phrase.partition("|")
    if who in _PLURAL:
        return f"{'are' if verb == 'be' else verb}{rest}"
    if verb in words().irregular:
        return words().irregular[verb][0] + rest
    return verb + ("es" if verb.endswith(("s", "sh", "ch", "x")) else "s") + rest


def _gerund(phrase: str) -> str:
    """A phrase with its verb in -ing."""
    verb, _, rest = phrase.partition("|")
    if verb in words().irregular:
        return words().irregular[verb][1] + rest
    return (verb[:-1] if verb.endswith("e") and not verb.endswith("ee") else verb) + "ing" + rest


def _written(text: str, rng: np.random.Generator) -> str:
    """A sentence as people write it: now and then with a capital and a full stop."""
    style = int(rng.integers(3))
    if style == 0:
        return f"{text[0].upper()}{text[1:]}."
    return f"{text}." if style == 1 and rng.random() < 0.5 else text


def _pick(rng: np.random.Generator, options: Sequence[str]) -> str:
    return options[int(rng.integers(len(options)))]
