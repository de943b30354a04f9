"""The plan of a conversion.

A converter plans before it converts: the plan lists what was found, what is missing and what will be left out
and why, so nothing is skipped silently (`convert ... --plan` prints it and stops).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from rich.markup import escape
from rich.table import Table

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of_json
from motionloom.datasets.base.json_doors import number
from motionloom.datasets.base.printable import printable
from motionloom.datasets.base.records import SPLITS, Dropped, Split
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.facts import Facts, parse_where, require_known
from motionloom.datasets.convert.common.look import Look
from motionloom.datasets.shards.left_out import drop, grouped, grouped_notes


class PlannedClip(Protocol):
    """A clip of a plan: what a converter hands to its function from clip to sample."""

    @property
    def id(self) -> str:
        """Its name in the data set."""
        ...

    @property
    def split(self) -> Split: ...

    def label(self) -> str:
        """Name in reports. A changed file must change it: name and size will do."""
        ...


C = TypeVar("C", bound=PlannedClip)


@dataclass
class ConversionPlan(Generic[C]):
    """The outcome for every file of a source: `items` become samples, all else is listed with its reason.

    A converter fills it while it decides what becomes of every file, and ends with `finish`.
    """

    config: ConvertConfig
    items: list[tuple[Split, C]] = field(default_factory=list)
    frames: dict[Split, int] = field(default_factory=dict)
    """Expected frames a split, at the target frame rate."""
    found: int = 0
    """Motion files in the source."""
    missing: list[Dropped] = field(default_factory=list)
    """Listed by captions or split files, but not in the source."""
    uncaptioned: list[str] = field(default_factory=list)
    """In the source, without captions."""
    bare_clips: list[str] = field(default_factory=list)
    """Clips that lack nothing but captions."""
    captioned: int = 0
    """Clips that have them, and nothing against them."""
    dropped: list[Dropped] = field(default_factory=list)
    """In the source and readable, but left out."""
    rejected: list[Dropped] = field(default_factory=list)
    """In the source and readable, but nothing says how they are to be read as a person's motion."""
    broken: list[Dropped] = field(default_factory=list)
    """In the source, but cannot be read."""
    notes: list[str] = field(default_factory=list)
    licences: dict[str, int] = field(default_factory=dict)
    """Clips to convert under each licence."""
    bytes_needed: int | None = None
    """Disk that the shards will take; None when unknown."""
    captions: str = ""
    """Number of clips with captions, and those without, where the user brought captions."""
    stop: str = ""
    """Decision that the user must take before it is carried out; empty when nothing is open."""
    look: Look | None = None
    """Measurements of a few clips; None when none was read."""
    stated: str = ""
    """Numbers that the makers of the source state, and where."""
    clips: int = 0
    """Clips found, taken or not, and their hours."""
    hours: float = 0.0
    ids: dict[str, str] = field(default_factory=dict)
    """Label of the first clip with each id."""
    known: set[str] = field(default_factory=set)
    """Names of the facts that `config.where` may ask for."""
    removed: list[tuple[Split, C]] = field(default_factory=list)
    """Clips that `data remove` took out of the set: no sample is made of them, nor are they named."""
    totals: Callable[[], None] = lambda: None
    """Counts frames and licences of `items`, once it is finished."""

    @property
    def name(self) -> str:
        return f"{self.config.source.name} -> {self.config.name}"

    def take(
        self, clip: C, reason: str = "", *, captioned: bool = False, wanted: bool = False, keep: bool = True
    ) -> None:
        """Take a clip, or leave it out: for `reason`, because another has its id, because `config.where` asks
        for others, or, where captions are `wanted` and those without any not to `keep`, for want of them.
        """
        if clip.id in self.ids:
            reason = f"second file for clip id '{clip.id}'; the first is {self.ids[clip.id]}"
        else:
            self.ids[clip.id] = clip.label()
        if wanted and not captioned:
            self.uncaptioned.append(clip.label())
            if not reason:
                self.bare_clips.append(clip.label())
                reason = "" if keep else "no usable caption"
        elif captioned and not reason:
            self.captioned += 1
        facts = facts_of(clip)
        self.known.update(facts)
        self.clips += 1
        self.hours += number(facts.get("seconds", 0.0), "seconds") / 3600
        if not reason and not all(one.holds(facts) for one in parse_where(self.config.where)):
            reason = f"not where {self.config.where.strip()}"
        if reason:
            self.leave_out(clip.label(), reason)
        else:
            self.items.append((clip.split, clip))

    def leave_out(self, source: str, reason: str) -> None:
        """This one could become a sample, but does not."""
        self.dropped.append(Dropped(source=source, reason=reason))

    def miss(self, source: str, reason: str) -> None:
        """This one is listed somewhere, but not in the source."""
        self.missing.append(Dropped(source=source, reason=reason))

    def reject(self, source: str, reason: str) -> None:
        """This one was meant to become a sample, and cannot."""
        self.rejected.append(Dropped(source=source, reason=reason))

    def fail(self, source: str, error: Exception) -> None:
        """This one cannot be read."""
        self.broken.append(drop(source, error))

    def fail_rows(self, bad: Mapping[str, str]) -> None:
        """These rows of the source's tables cannot be read."""
        for place, reason in bad.items():
            self.fail(place, UserError(reason))

    @contextmanager
    def reading(self, source: str) -> Iterator[None]:
        """Note `source` as broken, and why, if what is read within fails; the plan goes on without it."""
        try:
            yield
        except Exception as error:  # whatever a bad file, name or number makes of the libraries below
            self.fail(source, error)

    def limit(self, key: Callable[[C], str]) -> None:
        """Keep `config.limit` clips at most, chosen by a hash of their key, with a note of the choice."""
        most = self.config.limit
        if most is not None and most < len(self.items):
            self.notes.append(f"limited to {most} of {len(self.items)} clips")
            kept = set(sorted(sha256_of_json(key(clip)) for _, clip in self.items)[:most])
            self.items = [item for item in self.items if sha256_of_json(key(item[1])) in kept]

    def finish(
        self, *, found: int, frames: Callable[[C], int], licence: Callable[[C], str]
    ) -> ConversionPlan[C]:
        """Itself, with its totals; `frames` (at the target rate) and `licence` are asked about every clip."""
        if self.known:
            require_known(self.config.where, self.known)
        if self.stated:
            self.notes.append(f"{self.stated}; found here: {self.clips:,} clips, {self.hours:,.1f} hours")
        self.found, self.notes = found, grouped_notes(self.notes)

        def totals() -> None:
            self.frames = dict.fromkeys(SPLITS, 0)
            for split, clip in self.items:
                self.frames[split] += frames(clip)
            self.licences = dict(sorted(Counter(licence(clip) for _, clip in self.items).items()))

        self.totals = totals
        totals()
        return self

    def leave_removed(self, gone: Callable[[str, str], bool], record: str) -> None:
        """Take out what is removed, by id and label, and all that names it; `record` is named in the note."""
        self.removed = [item for item in self.items if gone(item[1].id, item[1].label())]
        if self.removed:
            self.notes.append(f"{len(self.removed):,} clips stay out, as they were removed ({record})")
        names = {clip.label() for _, clip in self.removed}
        self.items = [item for item in self.items if item[1].label() not in names]
        for drops in (self.missing, self.dropped, self.rejected, self.broken):
            names.update(one.source for one in drops if gone("", one.source))
            drops[:] = [one for one in drops if one.source not in names]
        self.notes = [note for note in self.notes if not any(name in note for name in names)]
        self.totals()

    def counts(self) -> dict[Split, int]:
        return {split: sum(s == split for s, _ in self.items) for split in SPLITS}

    def table(self) -> Table:
        table = Table("what", "clips", "frames", "detail", title=escape(f"plan: {self.name}"))
        counts = self.counts()
        table.add_row("found in the source", str(self.found), "", "")
        for split in SPLITS:
            table.add_row(split, str(counts[split]), str(self.frames.get(split, 0)), "")
        if self.uncaptioned:
            some = escape(_some(self.uncaptioned))
            table.add_row("without captions", str(len(self.uncaptioned)), "", some)
        kinds = (
            ("missing files", self.missing),
            ("left out", [*self.rejected, *self.dropped]),
            ("broken", self.broken),
        )
        for title, drops in kinds:
            table.add_row(title, str(len(drops)), "", escape(_some(grouped(drops))))
        for licence, count in sorted(self.licences.items()):
            table.add_row("licence", str(count), "", escape(licence))
        if self.bytes_needed is not None:
            table.add_row("disk", "", "", f"{self.bytes_needed / 2**20:,.1f} MiB")
        for note in self.notes:
            table.add_row("note", "", "", escape(printable(note)))
        if self.stop:
            table.add_row("stops here", "", "", escape(self.stop))
        return table

    def left_out(self) -> list[Dropped]:
        return [
            *(drop.model_copy(update={"kind": "missing"}) for drop in self.missing),
            *(drop.model_copy(update={"kind": "unreadable"}) for drop in self.broken),
            *self.rejected,
            *self.dropped,
        ]

    def require_settled(self) -> None:
        if self.stop:
            raise UserError(self.stop)


def facts_of(clip: PlannedClip) -> Facts:
    """Facts of a clip by name, for `where`: id, split, and the clip's own `facts`."""
    facts: Facts = getattr(clip, "facts", {})
    return {"id": clip.id, "split": clip.split, **facts}


def _some(lines: Sequence[object], limit: int = 5) -> str:
    more = [f"... and {len(lines) - limit} more"] if len(lines) > limit else []
    return "\n".join([*(printable(str(line)) for line in lines[:limit]), *more])
