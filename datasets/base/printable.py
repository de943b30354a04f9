"""Text of strangers (captions, names of joints, files and runs), made safe to show."""

from __future__ import annotations

import unicodedata

_JOINERS = "\u200c\u200d"
"""Invisible, but Persian, several Indian scripts and many emoji cannot be written without them."""


def printable(text: str) -> str:
    r"""The text on one line, with every character that a terminal or a log would obey written out.

    Newlines, ESC, other control characters, bidirectional overrides and lone surrogates become `\n`, `\x1b`,
    `\u202e`, `\ud800`; letters and spaces of all scripts stay.
    """
    return "".join(
        c
        if c.isprintable() or c in _JOINERS or unicodedata.category(c) == "Zs"
        else c.encode("unicode_escape").decode("ascii")
        for c in text
    )
