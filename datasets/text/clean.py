"""Captions as sources bring them -> captions to train on: tidy, and never a mere file name.

Some releases name a clip instead of describing it (`Dance_Break_Back_Cc_clip_2`). Such a name is kept as
words when it holds words, because it still says what is done; ids, paths and counters are refused.

The paper's faces are described by "commonly used emotion" alone (HumanTOMATO appendix K). A caption of the
whole motion sometimes names one ("a person happily jumps"): a truer text of the face than the caption itself.
Most captions name none, and none is made up.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

_CLIP_NUMBER = re.compile(r"clip ?\d+", re.IGNORECASE)
_INVISIBLE = re.compile("[\u200b\ufeff]")
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f]")
_WORD = re.compile(r"[^\W\d_]{2,}")
_CODE = re.compile(r"[a-z][A-Z]")
"""Fields in names of AIST++: gBR, sBM, cAll."""
_FILE = re.compile(r"\S+\.(?:npy|npz|pkl|txt|json|csv|bvh|fbx|mp4|avi|mov|wav|mp3|zip|tar)", re.IGNORECASE)
_SLASH = re.compile(r"[\\/]")
_FILING = frozenset({
    "body", "clip", "file", "frame", "frames", "id", "idx", "motion", "part", "recording", "sample", "seq",
    "sequence", "subset", "take", "video",
})  # fmt: skip
"""Words of folder and file names that describe no motion when they stand alone."""
_NOTHING = frozenset(("nan", "none", "null", "n/a", "unknown"))


def clean_caption(text: str) -> str:
    """One line of plain words: underscores become spaces, runs of blanks one, a last `clip N` is dropped.

    May be empty. Cleaning twice changes nothing.
    """
    words = _CONTROL.sub(" ", _INVISIBLE.sub("", text)).replace("_", " ").split()
    while number := next((n for n in (1, 2) if _CLIP_NUMBER.fullmatch(" ".join(words[-n:]))), 0):
        del words[-number:]
    return " ".join(words)


def usable_caption(text: str) -> bool:
    """Whether a caption, raw or cleaned, says anything: not empty, an id, a path, a file's name or `nan`."""
    raw = text.strip()
    if raw.lower() in _NOTHING or _FILE.fullmatch(raw):
        return False
    if _SLASH.search(raw) and not re.search(r"\s", raw) and re.search(r"[\d_]", raw):
        return False
    words = [w for w in re.split(r"[\s,.;:!?]+", clean_caption(raw)) if not re.search(r"\d", w)]
    found = [match for word in words for match in _WORD.findall(word) if not _CODE.match(match)]
    return any(word.lower() not in _FILING for word in found)


_EMOTIONS: dict[str, str] = {
    "happy": "happy happily happiness joy joyful joyfully cheerful cheerfully smile smiles smiling smiled "
    "laugh laughs laughing laughed grin grins grinning delighted glad gladly",
    "sad": "sad sadly sadness unhappy unhappily cry cries crying cried weep weeps weeping sob sobs sobbing "
    "sorrowful sorrowfully depressed gloomy gloomily upset",
    "angry": "angry angrily anger furious furiously mad enraged rage frown frowns frowning annoyed",
    "surprised": "surprised surprise amazed astonished shocked startled",
    "fearful": "afraid fear fearful fearfully scared frightened terrified",
    "disgusted": "disgust disgusted disgustedly",
    "neutral": "neutral expressionless",
}
"""Emotion -> words that name it, "unhappy" among them: whole words are compared."""

_EMOTION_OF = {word: emotion for emotion, words in _EMOTIONS.items() for word in words.split()}
_NOT = {"not", "no", "without", "never", "isn't", "doesn't"}


def emotion_of(captions: Iterable[str]) -> str | None:
    """The emotion that captions name; None if none or several. Negated words do not count."""
    found = set()
    for caption in captions:
        words = re.findall(r"[a-z']+", caption.lower())
        for before, word in zip(["", *words], words, strict=False):
            if word in _EMOTION_OF and before not in _NOT:
                found.add(_EMOTION_OF[word])
    return found.pop() if len(found) == 1 else None
