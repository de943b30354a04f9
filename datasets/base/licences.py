"""Licences of motion: which of several is the strictest, and the sentences that they ask for.

A model is bound by everything that it was made from: what holds for it is the strictest licence of its data.
The order is by what the licences forbid, our reading and no legal advice; one that is not known here is as
strict as any.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

CMU = "CMU-mocap"
"""mocap.cs.cmu.edu: free for all uses, not to be resold as it is; asks for an acknowledgement."""

_STRICTER = (
    re.compile(r"CC0-.*|MIT|Apache-2\.0|BSD-.*|Unlicense|public domain", re.IGNORECASE),
    re.compile(CMU, re.IGNORECASE),
    re.compile(r"CC-BY-\d.*", re.IGNORECASE),
    re.compile(r"CC-BY-SA-\d.*", re.IGNORECASE),
    re.compile(r"CC-BY-NC-\d.*|.*-noncommercial|LicenseRef-AIST-Dance-DB", re.IGNORECASE),
    re.compile(r"CC-BY-NC-SA-\d.*", re.IGNORECASE),
    re.compile(r"CC-BY-(?:NC-)?ND-\d.*", re.IGNORECASE),
)
"""Free; acknowledged; makers named; shared alike; not sold; both of these; not changed."""
UNKNOWN = "unknown"

CREDITS = {
    CMU: "The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with "
    "funding from NSF EIA-0196217."
}
"""Sentences that a licence asks for whatever set is under it."""


def strictest(licences: Iterable[str]) -> str:
    """The strictest of some licences, `unknown` for none; equally strict ones joined by ` AND `.

    A joined name counts as its parts, so that the strictest of several mixes is that of all their data.
    """
    parts = {part.strip() or UNKNOWN for name in licences for part in name.split(" AND ")} or {UNKNOWN}
    most = max(map(_rank, parts))
    return " AND ".join(sorted(part for part in parts if _rank(part) == most))


def credits_of(licences: Iterable[str], name: str, own: Iterable[str] = ()) -> list[str]:
    """The sentences that data under these licences ask for; `own` are those that are known of the data set.

    Of a set whose makers must be named, and nobody has said how, the sentence says that.
    """
    own = list(own)
    for part in sorted({part for licence in licences for part in licence.split(" AND ")}):
        if part in CREDITS:
            own.append(CREDITS[part])
        elif not own and re.match(r"CC-BY-", part, re.IGNORECASE):
            own.append(f"Motion of the data set '{name}' is under {part}: name its makers here.")
    return list(dict.fromkeys(own))


def _rank(licence: str) -> int:
    known = (rank for rank, names in enumerate(_STRICTER) if names.fullmatch(licence))
    return next(known, len(_STRICTER))
