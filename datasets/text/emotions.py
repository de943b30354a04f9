"""Emotion words of captions, for faces of clips that have no other text (HumanTOMATO appendix K).

The paper's faces are described by "commonly used emotion" alone. A caption of the whole motion sometimes
names one ("a person happily jumps"); its word is then a truer text of the face than the caption itself, which
is about the body. Most captions name none, and none is made up.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

WORDS: dict[str, str] = {
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

_EMOTION_OF = {word: emotion for emotion, words in WORDS.items() for word in words.split()}
_NOT = {"not", "no", "without", "never", "isn't", "doesn't"}


def emotion_of(captions: Iterable[str]) -> str | None:
    """The emotion that captions name, or None where they name none or several.

    A word behind "not", "no", "without" or "never" names nothing.
    """
    found = set()
    for caption in captions:
        words = re.findall(r"[a-z']+", caption.lower())
        for before, word in zip(["", *words], words, strict=False):
            if word in _EMOTION_OF and before not in _NOT:
                found.add(_EMOTION_OF[word])
    return found.pop() if len(found) == 1 else None
