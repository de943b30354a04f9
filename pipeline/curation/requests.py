"""Parse captions for the actions of the synthetic source, by patterns of English [ours]."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

from motionloom.datasets.actions.dances import Record
from motionloom.datasets.actions.requests import CaptionReader, CaptionRequest
from motionloom.datasets.base.register import register

_TABLE = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
_PATTERNS: dict[str, str] = _TABLE["actions"]
"""Words for each action."""
_DIRECTIONS: dict[str, dict[str, str]] = _TABLE["directions"]
_SPEEDS: dict[str, str] = _TABLE["speeds"]
_TWO_WORDS = (("turn", "walk"), ("hop", "jump"), ("reach", "bow"), ("reach", "stretch"), ("stretch", "raise"))
"""Pairs of which a caption with both asks for the first alone: who turns may walk."""
_RAISED = {"reach": "up", "stretch": "arms?"}
"""Words beside which a raised arm may be meant."""
_REVERSED = r"^before\b|\bafter (?!that|this|which)"
"""Words that reverse the order of two actions."""
_IN_TURN = r",?\s*(?:\b(?:and|but)\b)?\s*\b(?:then|afterwards|after (?:that|this|which)|finally)\b,?"
_NEGATIONS = (
    r"^nobody|\w+n't|no|not|never|none|nor|nothing|nowhere|without|instead|except|anything"
    r"|dont|doesnt|didnt|isnt|arent|wasnt|wont|cant|(stop|refuse|avoid)(s|d|ed)?|stopped"
)
_HAND = r"(?:the |his |her |their )?(left|right|both) hands?"
_FINGERS = {
    "fist": rf"(?:a |both )?fists? (?:with|of) {_HAND}|{_HAND} in(?:to)? (?:a )?fists?"
    rf"|{_HAND} (?:clenched|closed)|(?:\w+ )?fists? (?:is |are )?clenched"
    r"|(?:clench|ball|mak|clos)\w* (?:\w+ ){0,3}(?:fists?|hands?)\b",
    "point": rf"pointing (?:the index finger of|with) {_HAND}"
    r"|pointing with (?:the |his |her )?(left|right) index finger",
    "spread": rf"spread\w* the fingers of {_HAND}|the fingers of {_HAND} spread|{_HAND} (?:wide )?open\b"
    r"|(?:spread|open)(?:ing|s)? (?:wide )?(?:the |his |her |their )?(?:(?:left|right|both) )?"
    r"(?:fingers|hands?|palms?)\b|(?:fingers|hands|palms) (?:wide )?(?:spread|open)\b",
    "pinch": rf"pinch\w*(?: thumb and index finger)? (?:with|of) {_HAND}",
    "wave_fingers": rf"(?:wiggling|waving) the fingers of {_HAND}",
}
"""Phrases about fingers by the shape of the hand; their side is not the action's."""
_FOREIGN = (
    r"(dog|cat|horse|bird|monkey|bear|lion|tiger|elephant|rabbit|cow|pig|fish|snake|robot)s?"
    r"|jumping jacks?|over (a|an|the) (?!head|shoulder|left|right|floor|ground)\w+"
    r"|swim(s|ming)?|swam|stairs?|staircase|ladders?|hills?|slopes?|ramps?|escalators?"
    r"|(wav|clap|lift|rais|punch)\w* (?:\w+ ){0,2}(foot|feet|legs?|knees?|toes?)"
)
"""Who is no person, what a flat floor without things does not allow, and an arm's action by a leg."""
_COUNTED = ("kick", "punch", "hop", "jump", "squat", "clap")
_ONES = "two three four five six seven eight nine ten eleven twelve"
_TENS = "twenty thirty forty fifty sixty seventy eighty ninety"
_NUMBERS = {"once": 1, "single": 1, "twice": 2, "thrice": 3, "pair": 2, "dozen": 12, "hundred": 100}
_NUMBERS |= {word: n for n, word in enumerate(_ONES.split(), 2)}
_NUMBERS |= {word: 10 * n for n, word in enumerate(_TENS.split(), 2)}
_NOT_TIMES = r"(?! ?(?:hand|arm|fist|leg|knee|degree|step|second|minute|person)s?\b| ?(?:feet|people)\b)"
"""A number before one of these is not how often."""


def parse_requests(caption: str) -> CaptionRequest:
    """Return what a caption asks for, as truth records that state no more than it does."""
    text = re.sub(r"\b(a|one) minute\b", "60 seconds", caption.lower().replace("half a minute", "30 seconds"))
    text, hands = _without_hands(text)
    parts = [part for part in (part.strip(" ,.") for part in re.split(_IN_TURN, text)) if part]
    named = [parse_actions(part) for part in parts]
    actions = tuple(action for own in named for action in own)
    if not actions or (len(parts) > 1 and any(len(own) != 1 for own in named)):
        return CaptionRequest()
    if _has(text, _NEGATIONS):
        return CaptionRequest(refused=True, without=actions)
    if len(actions) > 2 or _has(text, _FOREIGN):
        return CaptionRequest(refused=True)
    lasting = re.search(rf"\bfor (?:about )?(\d+|{'|'.join(_NUMBERS)})[ -]seconds?\b", text)
    whole = hands | ({"seconds": _number(lasting[1])} if lasting else {})
    if len(actions) == 2:
        # Of two in one sentence it is not known which of them a side or a count belongs to.
        said = parts if len(parts) == 2 else ("", "")
        each = [attributes_of(part, action) for part, action in zip(said, actions, strict=True)]
        return CaptionRequest(({"action": "then", "parts": each, **whole},))
    meant = (*actions, "raise") if _has(text, _RAISED.get(actions[0], "(?!)")) else actions
    return CaptionRequest(tuple(attributes_of(text, action) | whole for action in meant))


def _without_hands(text: str) -> tuple[str, Record]:
    """A text without its phrases about fingers, and the shape of each hand that they ask for."""
    hands: Record = {}
    for shape, pattern in _FINGERS.items():
        for found in re.finditer(pattern, text):
            side = re.search("left|right", found[0])
            if side or _has(found[0], "both|fists|hands|palms|fingers"):
                hands |= {f"{one}_hand": shape for one in ([side[0]] if side else ["left", "right"])}
        text = re.sub(pattern, " ", text)
    return text, hands


def parse_actions(text: str) -> tuple[str, ...]:
    """Return the actions that a text in small letters names, each once, in the order in which to do them."""
    found = {
        action: match.start()
        for action, words in _PATTERNS.items()
        if (match := re.search(rf"\b({words})\b", text))
    }
    actions = tuple(sorted(found, key=lambda action: found[action]))
    for one, other in _TWO_WORDS:
        if set(actions) == {one, other}:
            return (one,)
    return actions[::-1] if len(actions) == 2 and re.search(_REVERSED, text) else actions


def attributes_of(text: str, action: str) -> Record:
    """The record of an action with the direction, side, count and speed that a text states."""
    out: Record = {"action": action}
    sides = [side for side in ("left", "right", "both") if _has(text, side)]
    if action in ("wave", "raise", "kick", "punch", "hop") and len(sides) == 1:
        out["side"] = sides[0]
    elif action in ("wave", "raise") and not sides and _has(text, "hands|arms"):
        out["side"] = "both"
    elif action in ("reach", "point"):
        # Without a hand beside it, "left" is where to.
        hand = re.search(r"\b(left|right) (?:hand|arm|index|finger)", text)
        out |= {"side": hand[1]} if hand else {}
    plain = text.replace("anti", "counter").replace("-", "")
    directions = [name for name, words in _DIRECTIONS.get(action, {}).items() if _has(plain, words)]
    if len(directions) == 1:
        out["direction"] = directions[0]
        if action == "walk" and directions == ["sideways"] and len(sides) == 1:
            out["side"] = sides[0]
    elif action in ("walk", "run") and _has(text, "circles?|laps?"):
        out["path"] = "a circle"  # either way round
    count = _count(text, action)
    if count is not None:
        out["count"] = count
    speeds = [name for name, words in _SPEEDS.items() if _has(text, words)]
    if len(speeds) == 1 and (action, *speeds) != ("run", "quickly"):
        out["speed"] = speeds[0]
    return out


def _count(text: str, action: str) -> int | None:
    """Return how often a text asks for an action; of one that is not counted, only where it says "times"."""
    following = _NOT_TIMES if action in _COUNTED else r"(?= ?times\b)"
    if action == "walk":
        following = r"(?= ?(?:times|steps)\b)"
    elif action in _COUNTED:
        words = _PATTERNS[action]
        again = re.search(rf"\b({words})\b(\W+({words})\b)+", text)
        if again:  # "jump jump jump"
            return len(re.findall(rf"\b({words})\b", again[0]))
        if _has(text, rf"one (\w+ )?({words})|one time"):
            return 1
    found = re.findall(rf"\bx?(\d+|{'|'.join(_NUMBERS)})x?\b{following}", text)
    numbers = set(map(_number, found))
    return numbers.pop() if len(numbers) == 1 else None


def _number(word: str) -> int:
    return int(word) if word.isdigit() else _NUMBERS[word]


def _has(text: str, pattern: str) -> bool:
    """Whether a text has one of these words."""
    return re.search(rf"\b({pattern})\b", text) is not None


register(CaptionReader("english", parse_requests, lambda caption: parse_actions(caption.lower())))
