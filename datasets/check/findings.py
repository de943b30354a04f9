"""Findings of a check: errors (do not train on this) and warnings (look at this), in bounded memory."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

LISTED = 1000
"""Findings of one kind that are kept with their places; the rest of that kind is counted."""


@dataclass(frozen=True)
class Problem:
    """One thing wrong: `where` names a file, and a key where there is one."""

    where: str
    message: str

    def __str__(self) -> str:
        return f"{self.where}: {self.message}"


@dataclass
class Findings:
    """Collects problems by kind. Kinds are short texts such as 'no captions'."""

    errors: list[Problem] = field(default_factory=list)
    warnings: list[Problem] = field(default_factory=list)
    error_kinds: Counter[str] = field(default_factory=Counter)
    """Number of errors of each kind, the unlisted ones too."""
    warning_kinds: Counter[str] = field(default_factory=Counter)

    def error(self, kind: str, where: str, message: str) -> None:
        """Something that makes the data wrong to use."""
        self.error_kinds[kind] += 1
        if self.error_kinds[kind] <= LISTED:
            self.errors.append(Problem(where, message))

    def warn(self, kind: str, where: str, message: str) -> None:
        """Something unusual that may be meant."""
        self.warning_kinds[kind] += 1
        if self.warning_kinds[kind] <= LISTED:
            self.warnings.append(Problem(where, message))

    def all_errors(self, root: str) -> list[Problem]:
        """The errors, and one line for each kind that has more than are listed."""
        return [*self.errors, *_unlisted(root, self.error_kinds)]

    def all_warnings(self, root: str) -> list[Problem]:
        return [*self.warnings, *_unlisted(root, self.warning_kinds)]


def _unlisted(root: str, kinds: Counter[str]) -> list[Problem]:
    return [Problem(root, f"{n - LISTED} more: {kind}") for kind, n in sorted(kinds.items()) if n > LISTED]
