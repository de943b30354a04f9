"""`UserError`, a mistake that the user can fix, and the hint at what was probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

_LONGEST = 2000
"""Characters of a line of a `UserError`: names and numbers of strangers in it may have any length."""

_MOST_LINES = 20


class UserError(Exception):
    """A mistake the user can fix. The command line prints the sentence alone, never a traceback.

    What a terminal or a log would obey is written out, and the middle is left out of what has no end.
    """

    def __init__(self, words: str = "") -> None:
        lines = list[str]()
        half = _LONGEST // 2
        said = words.split("\n")
        if len(said) > _MOST_LINES:  # names of strangers may hold line breaks
            said[_MOST_LINES - 2 : -1] = ["…"]
        for line in said:
            if not line.isprintable():
                line = "".join(c if c.isprintable() else repr(c)[1:-1] for c in line)
            lines.append(line if len(line) <= _LONGEST else f"{line[:half]} … {line[-half:]}")
        super().__init__("\n".join(lines))


def nearest(name: str, valid: Sequence[str], shown: Sequence[str] | None = None, what: str = "names") -> str:
    """A hint to append: did you mean 'x'?, or the list of valid names, or else of those `shown`."""
    near = difflib.get_close_matches(name, valid, n=1, cutoff=0.5)
    names = valid if shown is None else shown
    return f"; did you mean '{near[0]}'?" if near else f"; valid {what}: {', '.join(names)}"
