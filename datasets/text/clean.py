"""Captions as sources bring them -> captions to train on: tidy, and never a mere file name.

Some releases name a clip instead of describing it (`Dance_Break_Back_Cc_clip_2`). Such a name is kept as
words when it holds words, because it still says what is done; ids, paths and counters are refused.
"""

from __future__ import annotations

import re

_CLIP_NUMBER = re.compile(r"(?:^|\s+)clip\s*\d+$", re.IGNORECASE)
_INVISIBLE = re.compile("[\u200b\ufeff]")
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f]")
_WORD = re.compile(r"[^\W\d_]{2,}")
_CODE = re.compile(r"[a-z][A-Z]")
"""How AIST++ spells the fields of its names: gBR, sBM, cAll."""
_FILE = re.compile(r"\S+\.(?:npy|npz|pkl|txt|json|csv|bvh|fbx|mp4|avi|mov|wav|mp3|zip|tar)", re.IGNORECASE)
_PATH = re.compile(r"\S*[\\/]\S*")
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
    words = _CONTROL.sub(" ", _INVISIBLE.sub("", text)).replace("_", " ")
    words = " ".join(words.split())
    while (shorter := _CLIP_NUMBER.sub("", words)) != words:
        words = shorter
    return words


def usable_caption(text: str) -> bool:
    """Whether a caption, raw or cleaned, says anything: not empty, an id, a path, a file's name or `nan`."""
    raw = text.strip()
    if raw.lower() in _NOTHING or _FILE.fullmatch(raw):
        return False
    if _PATH.fullmatch(raw) and re.search(r"[\d_]", raw):
        return False
    words = [w for w in re.split(r"[\s,.;:!?]+", clean_caption(raw)) if not re.search(r"\d", w)]
    found = [match for word in words for match in _WORD.findall(word) if not _CODE.match(match)]
    return any(word.lower() not in _FILING for word in found)
