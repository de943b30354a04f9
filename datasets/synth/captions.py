"""Captions of a `Truth`: sentences that state every attribute that decides the motion, and nothing else.

Three vocabularies of `captions.json`: `few`, two or three words for each thing in sentences of one form;
`many`, a dozen verbs as statements, requests, headings or with the hands first, for models that have to
understand other words too (as `everyday` wordings one caption of a clip leaves side, number, speed and hands
unsaid, as people do); `dances`, the style of the legs, the genre and the tempo of dances to songs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from motionloom.datasets.base.config import Config
from motionloom.datasets.synth.actions.truth import Truth, takes_part
from motionloom.datasets.synth.dances import DanceTruth
from motionloom.datasets.synth.music.genres import GENRES

Wordings = Literal["few", "many", "everyday"]
Phrases = dict[str, tuple[str, ...]]

_GENDERED = ("a man", "a woman")
_PLURAL = ("they",)
_OBJECTS = {"he": "him", "she": "her", "they": "them"}
_NOBODY = ("a person", "the person", "someone", "a figure", "a human", "this person", "an individual")


class Vocabulary(Config):
    """Phrases by what they state."""

    who: tuple[str, ...]
    actions: Phrases
    bare: Phrases = Field(default_factory=dict)
    times: dict[int, tuple[str, ...]]
    speed: Phrases
    hands: Phrases
    faces: Phrases


class DanceVocabulary(Config):
    """Phrases about dances to songs; those about the music and the arms are in `genres.json`."""

    who: tuple[str, ...]
    styles: Phrases
    tempo: Phrases


class CaptionWords(Config):
    """`captions.json`."""

    note: str
    few: Vocabulary
    many: Vocabulary
    irregular: dict[str, tuple[str, str]]
    """Verb of `many` -> its third person and its -ing form."""
    dances: DanceVocabulary


@cache
def words() -> CaptionWords:
    """The tables, read once."""
    return CaptionWords.load_json(Path(__file__).with_suffix(".json"))


def body_captions(
    truth: Truth, rng: np.random.Generator, hands: bool = True, wordings: Wordings = "few"
) -> list[str]:
    """Three different captions of the body, or as many as there are wordings.

    `hands`: whether the motion holds hands that a caption may be about. Dances to songs have few wordings.
    """
    if isinstance(truth, DanceTruth):
        return _different(lambda: _dance(truth, rng), 3)
    if wordings == "few":
        return _different(lambda: _plain(truth, rng, hands), 3)
    if wordings == "many":
        return _different(lambda: _varied(truth, rng, hands), 3)
    said = _different(lambda: _varied(truth, rng, hands), 2)
    return [*said, *_different(lambda: _varied(truth, rng, False, bare=True), 3 - len(said))]


def face_captions(
    truth: Truth, rng: np.random.Generator, body: Sequence[str] = (), wordings: Wordings = "few"
) -> list[str]:
    """Two captions of the face alone, about a person that none of the clip's `body` captions contradicts.

    Any of them may be trained on together: where a body caption says "a woman" no face is a man's, and where
    others of the same clip say "a man" the face is a person's. With many wordings they name nobody in
    particular.
    """
    if wordings != "few" and not isinstance(truth, DanceTruth):
        faces = words().many.faces[truth.face]
        return _different(
            lambda: _written(f"{_pick(rng, _NOBODY)} {_third_person(_pick(rng, faces))}", rng), 2
        )
    faces = words().few.faces[truth.face]
    named = {who for who in _GENDERED if any(text.startswith(f"{who} ") for text in body)}
    people = tuple(who for who in words().few.who if who not in _GENDERED or named <= {who})
    order = rng.permutation(len(faces))[:2]
    return [f"{_pick(rng, people)} {faces[int(k)]}" for k in order]


def _plain(truth: Truth, rng: np.random.Generator, hands: bool) -> str:
    table = words().few

    def said(part: Truth) -> str:
        return _pick(rng, table.actions[_key(part)]).format(
            v=f" {_pick(rng, table.speed[part.speed])}" if part.speed else "",
            n=f" {_pick(rng, table.times[part.count])}" if part.count else "",
            s=_limb(part, rng) if part.action in ("wave", "raise") else part.side or "",
            b=part.bpm,
            t=_tempo(part),
        )

    text = " and then ".join(said(part) for part in truth.parts or (truth,))
    phrases = _hand_phrases(truth, rng, table.hands, 1, ("both hands",)) if hands else []
    return ", ".join([f"{_pick(rng, table.who)} {text}", *phrases[:1]]) + "".join(
        f" and {phrase}" for phrase in phrases[1:]
    )


def _varied(truth: Truth, rng: np.random.Generator, hands: bool, bare: bool = False) -> str:
    table = words().many

    def said(part: Truth) -> str:
        phrases = table.actions[_key(part)]
        return _pick(rng, table.bare.get(_key(part), phrases) if bare else phrases).format(
            s=part.side,
            h=_limb(part, rng, "both of the {}s", "the two {}s"),
            n=f" {_pick(rng, table.times[part.count])}" if part.count else "",
            v=f" {_pick(rng, table.speed[part.speed])}" if part.speed else "",
            b=part.bpm,
        )

    phrases = [said(part) for part in truth.parts or (truth,)]
    link = (
        _pick(rng, (", then ", " and then ", ", and after that ", " and afterwards ")) if truth.parts else ""
    )

    def inflected(verb: Callable[[str], str]) -> str:
        return link.join(verb(phrase) for phrase in phrases)

    # Statements are likelier than headings, orders and "we see": people write them most.
    form = int(rng.integers(8))
    who = _pick(rng, table.who)
    if form < 3:
        text = f"{who} {inflected(lambda phrase: _third_person(phrase, who))}"
    elif form < 5:
        text = f"{who} {'are' if who in _PLURAL else 'is'} {inflected(_gerund)}"
    elif form == 5:
        text = inflected(_gerund)
    elif form == 6:
        text = inflected(lambda phrase: phrase.replace("|", ""))
    else:
        seen = _pick(rng, ("this is", "we see", "one can see", "watch"))
        text = f"{seen} {_OBJECTS.get(who, who)} {inflected(_gerund)}"
    both = ("both hands", "each hand", "the left and the right hand")
    shapes = _hand_phrases(truth, rng, table.hands, 2, both) if hands else []
    if not shapes:
        return _written(text, rng)
    together = _pick(rng, (" and ", ", ")).join(shapes)
    if rng.random() < 0.25:
        return _written(f"{together}, {text}", rng)
    return _written(f"{text}, {together}", rng)


def _dance(truth: DanceTruth, rng: np.random.Generator) -> str:
    genre = GENRES[truth.genre]
    table = words().dances
    pace = _pick(rng, table.tempo[_tempo(truth)])
    who = _pick(rng, table.who)
    music = _pick(rng, genre.words)
    style = _pick(rng, table.styles[genre.style])
    arms = _pick(rng, genre.moves)
    return _pick(
        rng,
        (
            f"{who} {style} to {music}, {arms}",
            f"{who} dances to {music} at {truth.bpm} beats per minute, {arms}",
            f"{who} {style} to a {pace}beat of {truth.bpm} bpm, {arms}",
            f"{who} dances to {music} and {style}",
        ),
    )


def _key(truth: Truth) -> str:
    style = truth.style if truth.action == "turn" else None
    return " ".join(word for word in (truth.action, truth.direction, style) if word is not None)


def _tempo(truth: Truth) -> str:
    bpm = truth.bpm or 0
    return "slow" if bpm < 100 else "moderate" if bpm < 125 else "fast"


def _limb(truth: Truth, rng: np.random.Generator, *more: str) -> str:
    """The hand or arm that acts; `more` are other words for "both {}s"."""
    word = "hand" if truth.action == "wave" else _pick(rng, ("arm", "hand"))
    if truth.side != "both":
        return f"the {truth.side} {word}"
    return (_pick(rng, ("both {}s", *more)) if more else "both {}s").format(word)


def _hand_phrases(
    truth: Truth, rng: np.random.Generator, doing: Phrases, plural_forms: int, both: tuple[str, ...]
) -> list[str]:
    """Return phrases about the hands, unless the action itself already implies them.

    The first `plural_forms` phrases of each shape can be put into the plural, for one of the words `both`.
    """
    shapes = [
        (name, shape)
        for name, shape in (("left", truth.left_hand), ("right", truth.right_hand))
        if shape != "relaxed" and not takes_part(truth.action, truth.side, name)
    ]
    if len(shapes) == 2 and shapes[0][1] == shapes[1][1]:
        phrase = _pick(rng, doing[shapes[0][1]][:plural_forms])
        phrase = phrase.replace("a fist", "fists").replace("index finger", "index fingers")
        return [phrase.replace("in fists", "in a fist").format(h=_pick(rng, both))]
    return [_pick(rng, doing[shape]).format(h=f"the {name} hand") for name, shape in shapes]


def _third_person(phrase: str, who: str = "") -> str:
    """A phrase of `many` with its verb as "he" or "they" take it."""
    verb, _, rest = phrase.partition("|")
    if who in _PLURAL:
        return f"{'are' if verb == 'be' else verb}{rest}"
    if verb in words().irregular:
        return words().irregular[verb][0] + rest
    return verb + ("es" if verb.endswith(("s", "sh", "ch", "x")) else "s") + rest


def _gerund(phrase: str) -> str:
    """A phrase of `many` with its verb in -ing."""
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


def _different(make: Callable[[], str], number: int) -> list[str]:
    found: list[str] = []
    for _ in range(8 * number):
        text = make()
        if text not in found:
            found.append(text)
        if len(found) == number:
            break
    return found


def _pick(rng: np.random.Generator, options: Sequence[str]) -> str:
    return options[int(rng.integers(len(options)))]
