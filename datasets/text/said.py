"""What a caption says by its words: actions, and side, direction, count and speed of one [ours].

`action_of` and `claim_of` are for people's captions of recorded clips: one action of a short list, and only
what is said without doubt. `acts_said` and `asked_of` are for what is asked of a model that knows the actions
of the synthetic clips: all of these, by more words.
"""

from __future__ import annotations

import re
from typing import Any

Said = dict[str, Any]
"""What is said of one action: side, direction, count and speed, as in the truth of synthetic clips."""
Acts = tuple[str, ...]
"""What a motion does: an action of the synthetic clips (`truth.ACTIONS`), or several in turn."""

ACTIONS = {
    "turn": r"turn(s|ing)?",
    "walk": r"walk(s|ing)?",
    "run": r"(run|jog|dash)(s|es|ning|ging|ing)?",
    "wave": r"wav(e|es|ing)",
    "raise": r"(rais|lift)(e|es|s|ing)?",
    "kick": r"kick(s|ing)?",
    "punch": r"punch(es|ing)?",
    "hop": r"hop(s|ping)?",
    "jump": r"(jump|leap)(s|ing)?",
    "squat": r"squat(s|ting)?",
    "clap": r"clap(s|ping)?",
    "sit": r"(sit|sits|sitting)",
    "bow": r"bow(s|ing)?",
    "lie": r"(lie|lies|lying)",
    "crawl": r"crawl(s|ing)?",
}
_MORE = {
    "turn": r"(turn|pivot|spin|rotat)(e|s|es|ed|ing|ning)?|spun|about[- ]face|face the other way",
    "walk": r"(walk|stroll|wander|trudg|strid|ambl|saunter)(e|s|es|ed|ing)?"
    r"|(takes?|took|taking) (\w+ ){0,4}steps?|back away|back(s|ed|ing) (away|up|off)",
    "run": r"(run|jog|dash|sprint)(s|es|ed|ged|ning|ging|ing)?|ran",
    "wave": r"wav(e|es|ed|ing)",
    "raise": r"(rais|lift)(e|es|s|ed|ing)?|(arms?|hands?) (up|in the air)",
    "kick": r"kick(s|ed|ing)?",
    "punch": r"punch(es|ed|ing)?|(jab|uppercut)(s|bed|bing)?|(hit|swing|swung)(s|ting|ing)? .{0,60}fist",
    "hop": r"hop(s|ped|ping)?",
    "jump": r"(jump|leap)(s|ed|ing|t)?|skip(s|ping)? (with a )?rope",
    "squat": r"squat(s|ted|ting)?|crouch(es|ed|ing)?",
    "clap": r"clap(s|ped|ping)?|applau(d|ds|ded|ding|se)",
    "sit": r"sits?|sat|sitting|(take|took|has|have)s? a seat|taking a seat",
    "bow": r"bow(s|ed|ing)?|(bend|bends|bent|bending) (over|forward)",
    "lie": r"lies?|lying|lay(s|ing)? down",
    "crawl": r"crawl(s|ed|ing)?",
    "dance": r"(danc|groov)(e|es|ed|ing)|disco",
    "reach": r"reach(es|ed|ing)?|extend(s|ed|ing)? (a|an|one|the|his|her|their|your) (hand|arm)"
    r"|(pick|picks|picked|picking) (\w+ ){0,5}up",
    "point": r"point(s|ed|ing)?",
    "stretch": r"stretch(es|ed|ing)?",
}
"""As asked of a model: also other words for the same. Repeats are bounded, so that no caption takes long."""
_OTHERS = (
    r"then|while|after|before|danc\w+|reach\w*|point\w*|step\w*|not"
    r"|in place|on the spot|back and forth|to and fro|side to side"
)
"""Words of captions that are about more than `action_of` knows."""
_ONE_OF_BOTH = (("turn", "walk"), ("hop", "jump"), ("reach", "bow"), ("stretch", "raise"))
"""Two words that are said of one action, the first: who turns may walk."""
_ALSO = {"reach": "up", "stretch": "arms?"}
"""With these words, what may be meant is that an arm is raised."""
_LATER_FIRST = r"^before\b|\bafter (?!that|this|which)"
"""What makes of two actions the one that is named later the first."""
_HAND = r"(?:the |his |her |their )?(left|right|both) hands?"
HANDS = {
    "fist": rf"fists? (?:with|of) {_HAND}|{_HAND} in(?:to)? (?:a )?fists?",
    "point": rf"pointing (?:the index finger of|with) {_HAND}"
    r"|pointing with (?:the |his |her )?(left|right) index finger",
    "spread": rf"spread\w* the fingers of {_HAND}|the fingers of {_HAND} spread",
    "pinch": rf"pinch\w*(?: thumb and index finger)? (?:with|of) {_HAND}",
    "wave_fingers": rf"(?:wiggling|waving) the fingers of {_HAND}",
}
"""What is said of fingers, by the shapes of `truth.HANDS`."""
_WAYS = {
    "walk": {
        "clockwise": "clockwise",
        "counterclockwise": "counterclockwise",
        "backward": r"back(s|ed|ing)? (away|up|off)|step(s|ped|ping)? back",
    },
    "jump": {"forward": r"(long|broad) jumps?|forwards?|ahead"},
    "reach": {
        "up": r"(reach(es|ed|ing)?|stretch\w*) up|top|high|overhead|above",
        "down": r"down|floor|ground|toes",
        "forward": r"forwards?|in front|ahead",
    },
    "point": {"up": r"up|sky|ceiling|above", "forward": r"forwards?|in front|ahead"},
}
"""Where to, by words that `claim_of` does not look at."""
_SPEEDS = {
    "slowly": r"slow(ly)?|unhurried(ly)?|leisurely",
    "quickly": r"quick(ly)?|fast|rapid(ly)?|brisk(ly)?|hurried(ly)?",
}
_TIMES = {"once": 1, "one time": 1, "twice": 2, "two times": 2, "three times": 3, "thrice": 3}
_TIMES |= {"four times": 4, "five times": 5} | {f"{n} times": n for n in range(2, 6)}
_COUNTED = ("kick", "punch", "hop", "jump", "squat", "clap")
_NUMBERS = {"once": 1, "single": 1, "twice": 2, "thrice": 3, "pair": 2, "dozen": 12, "hundred": 100}
_ONES = "two three four five six seven eight nine ten eleven twelve"
_TENS = "twenty thirty forty fifty sixty seventy eighty ninety"
_NUMBERS |= {word: n for n, word in enumerate(_ONES.split(), 2)}
_NUMBERS |= {word: 10 * n for n, word in enumerate(_TENS.split(), 2)}
_STEPS = r"(?= ?(?:times|steps)\b)"
_NOT_TIMES = r"(?! ?(?:hand|arm|fist|leg|knee|degree|step|second|minute|person)s?\b| ?(?:feet|people)\b)"
"""What is not followed by one of these says how often."""


def says(text: str, pattern: str) -> bool:
    """Whether a text has these words."""
    return re.search(rf"\b({pattern})\b", text.lower()) is not None


def action_of(text: str) -> str | None:
    """The one action that a caption is about; None where it is about more, or about another."""
    found = [name for name, pattern in ACTIONS.items() if says(text, pattern)]
    if found == ["turn", "walk"]:
        found = ["turn"]
    return None if len(found) != 1 or says(text, _OTHERS) else found[0]


def claim_of(text: str) -> Said | None:
    """What a caption says of one action: `action` and any of `side`, `direction`, `count`; None otherwise."""
    action = action_of(text)
    said = {} if action is None else _claimed_of(text, action)
    return {"action": action} | said if said else None


def acts_said(caption: str) -> Acts:
    """The actions that a caption names, each once, in the order in which they are to be done."""
    text = without_hands(caption)
    found = {
        name: match.start() for name, words in _MORE.items() if (match := re.search(rf"\b({words})\b", text))
    }
    acts = tuple(sorted(found, key=lambda name: found[name]))
    for one, other in _ONE_OF_BOTH:
        if set(acts) == {one, other}:
            return (one,)
    return acts[::-1] if len(acts) == 2 and re.search(_LATER_FIRST, text) else acts


def meant_by(caption: str, acts: Acts) -> list[Acts]:
    """What a caption that names these actions may mean, the likelier first."""
    words = _ALSO.get(acts[0]) if len(acts) == 1 else None
    return [acts, ("raise",)] if words and says(caption, words) else [acts]


def asked_of(caption: str, action: str) -> Said:
    """What a caption asks of an action that it names or may mean."""
    text = without_hands(caption).replace("anti", "counter")
    said = _claimed_of(text, action)
    if action in ("wave", "raise") and "side" not in said and says(text, "hands|arms"):
        said["side"] = "both"
    if action in ("reach", "point"):
        hand = re.search(r"\b(left|right) (?:hand|arm|index|finger)", text)
        said |= {"side": hand[1]} if hand else {}
    ways = [way for way, words in _WAYS.get(action, {}).items() if says(text.replace("-", ""), words)]
    if len(ways) == 1:
        said["direction"] = ways[0]
    count = _count_of(text, action)
    if count is not None:
        said["count"] = count
    speeds = [speed for speed, words in _SPEEDS.items() if says(text, words)]
    if len(speeds) == 1 and (action, *speeds) != ("run", "quickly"):
        said["speed"] = speeds[0]
    return said


def _count_of(text: str, action: str) -> int | None:
    """How often a caption asks for an action; of one that is not counted, if it says so in so many words."""
    times = _NOT_TIMES if action in _COUNTED else _STEPS if action == "walk" else r"(?= ?times\b)"
    if action in _COUNTED:
        words = _MORE[action]
        again = re.search(rf"\b({words})\b(\W+({words})\b)+", text)
        if again:
            return len(re.findall(rf"\b({words})\b", again[0]))
        if says(text, rf"one (\w+ )?({words})"):
            return 1
    found = re.findall(rf"\bx?(\d+|{'|'.join(_NUMBERS)})x?\b{times}", text)
    numbers = {int(one) if one.isdigit() else _NUMBERS[one] for one in found}
    return numbers.pop() if len(numbers) == 1 else None


def _claimed_of(text: str, action: str) -> Said:
    """What a caption says of an action without doubt."""
    out: Said = {}
    sides = [side for side in ("left", "right", "both") if says(text, side)]
    ways = [way for way in ("forward", "backward") if says(text, f"{way}s?")]
    if len(sides) == 1 and action in ("wave", "raise", "kick", "punch", "hop"):
        out["side"] = sides[0]
    if action == "turn" and len(sides) == 1 and sides != ["both"]:
        out["direction"] = sides[0]
    if action in ("walk", "run") and len(ways) == 1 and not sides and not says(text, r"circles?|back"):
        out["direction"] = ways[0]
    counts = {times for words, times in _TIMES.items() if says(text, words)}
    if len(counts) == 1 and action in _COUNTED:
        out["count"] = counts.pop()
    return out


def without_hands(caption: str) -> str:
    """A caption in small letters without what it says of fingers, whose side is not that of the action."""
    text = caption.lower()
    for pattern in HANDS.values():
        text = re.sub(pattern, " ", text)
    return text
