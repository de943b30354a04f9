"""The plan of a conversion.

A converter plans before it converts: the plan lists what was found, what is missing and what will be left out
and why, so nothing is skipped silently (`convert ... --plan` prints it and stops). Every entry of the source
and every line of its lists ends in one bin (`account`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Generic, Literal, NamedTuple

from rich.markup import escape
from rich.table import Table

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of_json
from motionloom.datasets.base.json_doors import number
from motionloom.datasets.base.printable import printable
from motionloom.datasets.base.records import SPLITS, Dropped, Split
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.facts import parse_where, require_known
from motionloom.datasets.convert.common.files import Walk
from motionloom.datasets.convert.common.look import Look
from motionloom.datasets.convert.common.planned import C, Totals, Words, facts_of, file_of, words_of
from motionloom.datasets.convert.common.splits import ListLine
from motionloom.datasets.shards.left_out import drop, grouped, grouped_notes

Fate = Literal["skipped", "rejected", "unreadable", "missing"]
"""What becomes of one that is no clip; those that a conversion was to read, rejected or not, are lost."""
_ENTRIES = "entries of the source"
_BINS = {"clip": "of clips", "beside": "read with them", "left out": "left out", "missing": "missing",
         "not ours": "not ours"}  # fmt: skip
"""Where entries and lines end, and the words of the sums."""


class NotTaken(NamedTuple):
    """One that becomes no clip."""

    record: Dropped
    fate: Fate
    names: tuple[str, ...]
    """Its file and id."""


@dataclass
class Known:
    """What the draft has seen of the source so far."""

    ids: dict[str, str] = field(default_factory=dict)
    """Label of the first clip with each id."""
    facts: set[str] = field(default_factory=set)
    """Names of the facts that `config.where` may ask for."""
    beside: set[str] = field(default_factory=set)
    """Files of the source, without motion, that clips are made with: words, sound, lists."""
    limited: set[str] = field(default_factory=set)
    """Files and ids of clips that `config.limit` leaves out."""
    lines: list[ListLine] = field(default_factory=list)
    """Lines of caption tables and split lists."""


@dataclass
class ConversionPlan(Generic[C]):
    """The outcome for every file of a source: `items` become samples, all else is listed with its reason.

    A converter fills it while it decides what becomes of every file, and ends with `finish`.
    """

    config: ConvertConfig
    items: list[tuple[Split, C]] = field(default_factory=list)
    not_taken: list[NotTaken] = field(default_factory=list)
    not_ours: list[Dropped] = field(default_factory=list)
    """Entries that are not read and lines that say nothing of a clip: for the list of what is left out."""
    notes: list[str] = field(default_factory=list)
    bins: dict[str, Counter[str]] = field(default_factory=dict)
    """Numbers of entries of the source, and of lines of each list, by what becomes of them (`_BINS`)."""
    owners: dict[str, list[tuple[str, str]]] = field(default_factory=dict)
    """The bins, and the places of lines, that count for a clip, by its file's name or its id."""
    stated: str = ""
    """Numbers that the makers of the source state, and where."""
    base: str = ""
    """Folder of the source, with a slash behind it, that the names of motion files begin in."""
    known: Known = field(default_factory=Known)
    words: Words = field(default_factory=Words)
    totals: Totals = field(default_factory=Totals)
    stop: str = ""
    """Decision that the user must take before it is carried out; empty when nothing is open."""
    look: Look | None = None
    """Measurements of a few clips; None when none was read."""
    removed: list[tuple[Split, C]] = field(default_factory=list)
    """Clips that `data remove` took out of the set: no sample is made of them, nor are they named."""

    @property
    def name(self) -> str:
        return f"{self.config.source.name} -> {self.config.name}"

    @property
    def missing(self) -> list[Dropped]:
        """Listed by captions or split files, but not in the source; and entries that lead nowhere."""
        return self._of("missing")

    @property
    def dropped(self) -> list[Dropped]:
        """In the source and readable, but left out."""
        return self._of("skipped")

    @property
    def rejected(self) -> list[Dropped]:
        """In the source and readable, but nothing says how they are to be read as a person's motion."""
        return self._of("rejected")

    @property
    def broken(self) -> list[Dropped]:
        """In the source, but cannot be read."""
        return self._of("unreadable")

    def _of(self, fate: Fate) -> list[Dropped]:
        return [one.record for one in self.not_taken if one.fate == fate]

    def add(
        self, clip: C, reason: str = "", *, captioned: bool = False, wanted: bool = False, keep: bool = True
    ) -> None:
        """Add a clip, or skip it: for `reason`, because another has its id, because `config.where` asks
        for others, or, where captions are `wanted` and those without any not to `keep`, for want of them.
        """
        ids = self.known.ids
        words = self.words
        if clip.id in ids:
            reason = f"second file for clip id '{clip.id}'; the first is {ids[clip.id]}"
        else:
            ids[clip.id] = clip.label()
        if wanted and not captioned:
            words.uncaptioned.append(clip.label())
            if not reason:
                words.bare.append(clip.label())
                reason = "" if keep else "no usable caption"
        elif captioned and not reason:
            words.captioned += 1
        facts = facts_of(clip)
        self.known.facts.update(facts)
        self.totals.clips += 1
        self.totals.hours += number(facts.get("seconds", 0.0), "seconds") / 3600
        if not reason and not all(one.holds(facts) for one in parse_where(self.config.where)):
            reason = f"not where {self.config.where.strip()}"
        if reason:
            self._leave(clip.label(), reason, "skipped", file_of(clip), clip.id)
        else:
            self.items.append((clip.split, clip))

    def skip(self, source: str, reason: str) -> None:
        """Leave out what could become a sample."""
        self._leave(source, reason, "skipped")

    def mark_missing(self, source: str, reason: str, *names: str) -> None:
        """Leave out what is listed somewhere, by these further names, but not in the source."""
        self._leave(source, reason, "missing", *names)

    def mark_rejected(self, clip: C, reason: str) -> None:
        """Leave out a clip that was meant to become a sample, and cannot."""
        self._leave(clip.label(), reason, "rejected", file_of(clip), clip.id)

    def mark_unreadable(self, source: str, error: Exception, *names: str) -> None:
        """Leave out what cannot be read, and what is known by these further names."""
        self._leave(source, drop(source, error).reason, "unreadable", *names)

    def _leave(self, source: str, reason: str, fate: Fate, *names: str) -> None:
        kind = fate if fate == "unreadable" or fate == "missing" else "rejected"
        record = Dropped(source=source, reason=reason, kind=kind)
        self.not_taken.append(NotTaken(record, fate, (source, *names)))

    def mark_rows_unreadable(self, bad: Mapping[str, str]) -> None:
        """Leave out rows of the source's tables that cannot be read, by their places."""
        for place, reason in bad.items():
            self.mark_unreadable(place, UserError(reason))

    @contextmanager
    def reading(self, source: str) -> Iterator[None]:
        """Note that clips are made with the file `source`; or that it is broken, and why, if what is read
        within fails. The plan goes on without it.
        """
        self.known.beside.add(source)
        try:
            yield
        except Exception as error:  # whatever a bad file, name or number makes of the libraries below
            self.mark_unreadable(source, error)

    def limit(self) -> None:
        """Keep `config.limit` clips at most, chosen by a hash of their ids, with a note of the choice."""
        most = self.config.limit
        if most is None or most >= len(self.items):
            return
        self.notes.append(f"limited to {most} of {len(self.items)} clips")
        kept = set(sorted((clip.id for _, clip in self.items), key=sha256_of_json)[:most])
        for _, clip in self.items:
            if clip.id not in kept:
                record = Dropped(source=clip.label(), reason=f"not among the {most} clips of the limit")
                self.not_ours.append(record)
                self.known.limited |= {clip.id, file_of(clip)}
        self.items = [item for item in self.items if item[1].id in kept]

    def finish(
        self, *, found: int, frames: Callable[[C], int], licence: Callable[[C], str]
    ) -> ConversionPlan[C]:
        """Itself, with its totals; `frames` (at the target rate) and `licence` are asked about every clip."""
        totals = self.totals
        if self.known.facts:
            require_known(self.config.where, self.known.facts)
        if self.stated:
            hours = f"{totals.clips:,} clips, {totals.hours:,.1f} hours"
            self.notes.append(f"{self.stated}; found here: {hours}")
        self.totals.found = found
        self.notes = grouped_notes(self.notes)

        def count() -> None:
            totals.frames = dict.fromkeys(SPLITS, 0)
            for split, clip in self.items:
                totals.frames[split] += totals.measured.get(clip.id) or frames(clip)
            totals.licences = dict(sorted(Counter(licence(clip) for _, clip in self.items).items()))

        totals.count = count
        count()
        return self

    def account(self, walked: Walk, beside: tuple[str, ...] = ()) -> None:
        """Put every entry of the source and every line of its lists into one bin, and sum them up.

        `walked` are the entries, and `beside` endings of files that motion files are read with. What could
        not be read and no clip has named is missing; a motion file that nothing has named is left out.
        """
        base = self.base
        clips = {base + file_of(clip) for _, clip in self.items}
        fates = {base + name: one.fate for one in self.not_taken for name in one.names}
        limited = {base + name for name in self.known.limited}
        # A file beside the clips that is of no use to any of them is still a file that was read.
        read = self.known.beside | _given(self.config, walked)
        homes = {_home(name) for name in (*clips, *fates, *limited)}
        bins = self.bins.setdefault(_ENTRIES, Counter())
        entries = dict.fromkeys(walked.files, "") | walked.unread | walked.others
        for name, reason in entries.items():
            if name in clips:
                bins["clip"] += 1
                self.owners.setdefault(name.removeprefix(base), []).append((_ENTRIES, ""))
            elif name in fates or name in limited:
                bins["missing" if fates.get(name) == "missing" else "left out"] += 1
            elif name in walked.unread:
                bins["missing"] += 1
                self.mark_missing(name, reason)
            elif not reason and (name in read or name.lower().endswith(beside or ("\0",))):
                bins["beside"] += 1
            elif not reason and _home(name) in homes and not PurePosixPath(name).name.startswith("."):
                bins["left out"] += 1
                self.skip(name.removeprefix(base), "nothing in the lists of the source names it")
            else:
                bins["not ours"] += 1
                self.not_ours.append(Dropped(source=name, reason=reason or "not read", kind="not ours"))
        self._account_lines()

    def _account_lines(self) -> None:
        """Put every line of the lists into one bin: that of its clip, unless it says nothing of one."""
        clips = {name: clip for _, clip in self.items for name in (clip.id, file_of(clip))}
        fates = {name: one.fate for one in self.not_taken for name in one.names}
        for line in self.known.lines:
            what = f"lines of {line.place.rpartition(':')[0]}"
            bins = self.bins.setdefault(what, Counter())
            clip = clips.get(line.key)
            reason = line.reason
            if clip is not None and line.words and not reason and not line.words & words_of(clip):
                reason = "none of its captions is of the clip's time"
            is_known = line.key in self.known.limited or fates.get(line.key, "missing") != "missing"
            if reason or (clip is None and is_known):
                bins["left out"] += 1
                reason = reason or f"its clip {line.key} is left out"
                self.not_ours.append(Dropped(source=line.place, reason=reason))
            elif clip is not None:
                bins["clip"] += 1
                self.owners.setdefault(line.key, []).append((what, line.place))
            else:
                bins["not ours" if line.is_catalogue else "missing"] += 1

    @property
    def sums(self) -> list[str]:
        """Entries of the source, and lines of each list, by what became of them."""
        sums = []
        for what, bins in self.bins.items():
            parts = ", ".join(f"{bins[key]:,} {words}" for key, words in _BINS.items() if bins[key])
            sums.append(f"{bins.total():,} {what}: {parts or 'none'}")
        return sums

    def reject(self, failed: Iterable[Dropped]) -> None:
        """Leave out clips that could not be converted, with the entries and lines that name them."""
        reasons = {one.source: one.reason for one in failed}
        lost = [clip for _, clip in self.items if clip.label() in reasons]
        self.items = [item for item in self.items if item[1].label() not in reasons]
        kept = {file_of(clip) for _, clip in self.items}
        for clip in lost:
            self.mark_rejected(clip, reasons[clip.label()])
            for name in {clip.id, file_of(clip)} - kept:
                for what, place in self.owners.pop(name, ()):
                    self.bins[what].update({"clip": -1, "left out": 1})
                    if place:
                        self.not_ours.append(Dropped(source=place, reason=f"its clip {name} is left out"))
        self.totals.count()

    def leave_removed(self, gone: Callable[[str, str], bool], record: str) -> None:
        """Take out what is removed, by id and label, and all that names it; `record` is named in the note."""
        self.removed = [item for item in self.items if gone(item[1].id, item[1].label())]
        if self.removed:
            self.notes.append(f"{len(self.removed):,} clips stay out, as they were removed ({record})")
        names = {clip.label() for _, clip in self.removed}
        self.items = [item for item in self.items if item[1].label() not in names]
        left_out = [one.record for one in self.not_taken] + self.not_ours
        names.update(one.source for one in left_out if gone("", one.source))
        self.not_taken = [one for one in self.not_taken if one.record.source not in names]
        self.not_ours = [one for one in self.not_ours if one.source not in names]
        self.notes = [note for note in self.notes if not any(name in note for name in names)]
        self.totals.count()

    def counts(self) -> dict[Split, int]:
        return {split: sum(s == split for s, _ in self.items) for split in SPLITS}

    def table(self) -> Table:
        table = Table("what", "clips", "frames", "detail", title=escape(f"plan: {self.name}"))
        counts = self.counts()
        totals = self.totals
        uncaptioned = self.words.uncaptioned
        table.add_row("found in the source", str(totals.found), "", "")
        for split in SPLITS:
            table.add_row(split, str(counts[split]), str(totals.frames.get(split, 0)), "")
        if uncaptioned:
            table.add_row("without captions", str(len(uncaptioned)), "", escape(_some(uncaptioned)))
        kinds = (
            ("missing files", self.missing),
            ("left out", [*self.rejected, *self.dropped]),
            ("broken", self.broken),
        )
        for title, drops in kinds:
            table.add_row(title, str(len(drops)), "", escape(_some(grouped(drops))))
        for licence, count in sorted(totals.licences.items()):
            table.add_row("licence", str(count), "", escape(licence))
        if totals.bytes_needed is not None:
            table.add_row("disk", "", "", f"{totals.bytes_needed / 2**20:,.1f} MiB")
        for line in self.sums:
            table.add_row("accounted", "", "", escape(printable(line)))
        for note in self.notes:
            table.add_row("note", "", "", escape(printable(note)))
        if self.stop:
            table.add_row("stops here", "", "", escape(self.stop))
        return table

    def left_out(self) -> list[Dropped]:
        return [*self.missing, *self.broken, *self.rejected, *self.dropped]

    def require_settled(self) -> None:
        if self.stop:
            raise UserError(self.stop)


def _given(config: ConvertConfig, walked: Walk) -> set[str]:
    """The entries that options name: a file, or all files of a folder."""
    values = [getattr(config, key) for key in type(config).model_fields if key != "source"]
    each = [one for value in values for one in (value if isinstance(value, tuple) else (value,))]
    source = config.source.absolute()
    within = {one.absolute() for one in each if isinstance(one, Path)} - {source}
    names = [(name, source / name) for name in walked.files]
    return {name for name, path in names if not within.isdisjoint((path, *path.parents))}


def _home(name: str) -> tuple[str, str]:
    """Folder and ending of a file, by which motion files are told from others."""
    path = PurePosixPath(name)
    return str(path.parent), path.suffix.lower()


def _some(lines: Sequence[object], limit: int = 5) -> str:
    more = [f"... and {len(lines) - limit} more"] if len(lines) > limit else []
    return "\n".join([*(printable(str(line)) for line in lines[:limit]), *more])
