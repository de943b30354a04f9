"""Keys as people read them: `left_hand` is "left hand" in pages and tables, and stays `left_hand` in JSON.

Settings and names of stages stay as they are typed, for they are what one types again.
"""

from __future__ import annotations

import re

_SHORT = {
    "align": "alignment",
    "ce": "cross-entropy",
    "commit": "commitment",
    "dead": "dead codes",
    "kl": "KL",
    "rec": "reconstructed",
    "recon": "reconstruction",
    "resets": "reset codes",
    "usage": "used codes",
}
"""What the log calls shorter than a page would."""
_OF_STREAM = re.compile(r"((?:tokens_)?(?:accuracy|dead|penalty|perplexity|resets|usage))_(.+)")
_LEVEL = re.compile(r"level(\d+)")
_ONLY = "code"
"""The stream of a tokenizer that has no other."""


def label(key: str) -> str:
    """An attribute, a feature or the value of one, in words."""
    return key.replace("_", " ")


def curve_label(key: str) -> str:
    """A figure of a training log: "accuracy: body" for `accuracy_body`, "cross-entropy" for `ce`."""
    found = _OF_STREAM.fullmatch(key)
    figure, stream = found.groups() if found else (key, "")
    words = " ".join(_SHORT.get(piece, piece) for piece in figure.split("_"))
    if stream in ("", _ONLY):
        return words
    level = _LEVEL.fullmatch(stream)
    return f"{words}: {f'level {level[1]}' if level else label(stream)}"
