"""Captions and split files of your own in a conversion: the options, which file a name means, what is left.

A name in captions and in split files means the same: the file at that path (its suffix does not matter), else
the only file whose path ends with it (`walk` means `walks/walk.bvh`). It never means a file by its own end
alone: `s2/walk` is another's clip than `walk.bvh`. Only where all names begin in one folder that the source
does not have (`/data/mocap/walks/walk.bvh`), the source is taken for it, and that is said.
"""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of, sha256_of_json
from motionloom.datasets.base.records import SPLITS, Caption, Split
from motionloom.datasets.convert.captions.collect import Captions, caption_files, holds_captions
from motionloom.datasets.convert.captions.read import CaptionRow, bare, joined, place_of
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.planned import C
from motionloom.datasets.convert.common.splits import (
    ListLine,
    SplitLists,
    SplitRule,
    hash_split,
    read_split_files,
)


class FileNames:
    """The files of a source, found by the names that people give them."""

    def __init__(self, paths: Iterable[str]) -> None:
        self._whole = {path_name(path): path for path in paths}
        self._by_end: dict[str, list[str]] = {}
        for name, path in self._whole.items():
            for end in _ends(name)[1:]:
                self._by_end.setdefault(end, []).append(path)
        # Letters with accents have two spellings, of which a disk and a table may have one each.
        for name, path in list(self._whole.items()):
            self._whole.setdefault(composed(name), path)

    def call(self, name: str, path: str) -> None:
        """Give a file a further name."""
        self._whole.setdefault(name, path)

    def find(self, name: str, prefix: str = "") -> tuple[str | None, str]:
        """The file that a name means, with the folder `prefix` for the source; and why it is none, although
        several fit.
        """
        name = bare(name)
        if prefix:
            return self._at(name.removeprefix(prefix)), ""
        whole = self._at(name)
        fits = [whole] if whole else self._by_end.get(name, [])
        if len(fits) > 1:
            return None, f"'{name}' may mean {' or '.join(fits[:_SHOWN])}; write the folder too"
        return (fits[0] if fits else None), ""

    def _at(self, name: str) -> str | None:
        return self._whole.get(name) or self._whole.get(composed(name))

    def prefix_of(self, names: Sequence[str]) -> str:
        """The folder, with a slash behind it, that all names begin in and that stands for the source, because
        none of them is found otherwise; empty when there is none.
        """
        known = [bare(name) for name in names]
        if not known or any(self.find(name) != (None, "") for name in known):
            return ""
        pieces = known[0].split("/")[:-1]
        for count in range(1, len(pieces) + 1):
            prefix = "".join(f"{piece}/" for piece in pieces[:count])
            if not all(name.startswith(prefix) for name in known):
                break
            if any(self._at(name.removeprefix(prefix)) for name in known):
                return prefix
        return ""

    def find_end(self, name: str) -> str | None:
        """The only file whose path ends as a name of another collection's does, by as much of it as fits."""
        for end in _ends(bare(name)):
            fits = {*self._by_end.get(end, ()), *([self._whole[end]] if end in self._whole else ())}
            if fits:
                return fits.pop() if len(fits) == 1 else None
        return None


def path_name(path: str) -> str:
    """The name of a file in the source: its path without the suffix of a motion file."""
    return path if "\\" in path else bare(path)


def composed(name: str) -> str:
    """A name in the usual one of the spellings that look alike."""
    return unicodedata.normalize("NFC", name)


def _ends(name: str) -> list[str]:
    """`a/b/c`, `b/c`, `c`."""
    pieces = name.split("/")
    return ["/".join(pieces[first:]) for first in range(len(pieces))]


@dataclass(frozen=True)
class Listing:
    """Captions and splits of the files of a source, by their paths there."""

    rows: dict[str, CaptionRow]
    splits: dict[str, Split] | None
    """None without split files."""
    missing: dict[str, str]
    """Names of clips that are listed but not here, and what was listed."""
    unused: list[CaptionRow]
    free: tuple[str, ...]
    """Files without captions."""
    notes: list[str]
    lines: list[ListLine] = field(default_factory=list)
    """What every line of captions and split files says of which file."""
    rule: SplitRule | None = None
    """The rule that the user has named in place of split files."""

    def id_of(self, path: str) -> str:
        return self.rows[path].id if path in self.rows else path_name(path)

    def split_of(self, path: str) -> Split:
        """By the user's rule or split files, else the captions, else a hash of the id."""
        stated = self.rows[path].split if path in self.rows else None
        listed = None if self.rule else (self.splits or {}).get(path) or stated
        rule = self.rule or SplitRule()
        return listed or hash_split(rule.name(self.id_of(path), path), rule.seed)

    def empty_splits(self, paths: Mapping[str, Split]) -> list[str]:
        """Return a note on splits that a hash leaves without a clip; none for lists."""
        empty = [split for split in SPLITS if split not in paths.values()]
        stated = self.rule is None and any(row.split for row in self.rows.values())
        if not empty or not paths or stated or self.splits is not None:
            return []
        lists = ", ".join(f"{split}.txt" for split in SPLITS)
        return [f"no clip is in {' or '.join(empty)}; give lists ({lists}: --set splits=FOLDER)"]

    def texts_of(self, path: str) -> tuple[Caption, ...]:
        return self.rows[path].texts if path in self.rows else ()

    def problem(self, path: str) -> str:
        """Return the reason that the lists leave a file out; empty when they do not."""
        return "in no split file" if self.splits is not None and path not in self.splits else ""


@dataclass
class _Matches:
    """The file of each caption row, as they are found."""

    names: FileNames
    found: dict[str, CaptionRow] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    unused: list[CaptionRow] = field(default_factory=list)
    files: dict[str, str] = field(default_factory=dict)
    """File of every row by its id."""
    refused: dict[str, str] = field(default_factory=dict)
    """Why a row, by its id, is not used although a file fits."""

    def match(self, row: CaptionRow, prefix: str) -> None:
        """Find the file of a row."""
        refused = ""
        path: str | None
        if row.catalogue:
            path = self.names.find_end(row.file or row.id) or self.names.find_end(row.id)
        else:
            path, refused = self.names.find(row.file or row.id, prefix)
            if path is None and row.file is not None and not refused:
                path, refused = self.names.find(row.id, prefix)
        before = None if path is None else self.found.get(path)
        if path is not None and before is not None:
            # Of two rows in one file, that which names the whole path counts.
            if row.catalogue or row.origin != before.origin:
                self.found[path] = joined(before, replace(row, id=before.id, file=None))
            elif bare(row.file or row.id) == path_name(path) != bare(before.file or before.id):
                self.found[path] = row
                self.refused[before.id] = f"'{before.id}' and '{row.id}' both mean {path}; the latter counts"
            else:
                refused = f"'{row.id}' and '{before.id}' both mean {path}; the latter counts"
        elif path is not None:
            self.found[path] = row
        if refused:
            self.refused[row.id] = refused
        elif path is not None:
            self.files[row.id] = path
        else:
            self.unused.append(row)
            if not row.catalogue:
                self.missing[row.file or row.id] = row.id


def list_clips(
    paths: Sequence[str], rows: Iterable[CaptionRow], listed: SplitLists | None, notes: list[str]
) -> Listing:
    """Find the file of every caption row and of every name in the split files (`listed`)."""
    names = FileNames(paths)
    matches = _Matches(names)
    rows = list(rows)
    # A catalogue lists a whole collection under other folders, so only the ends of its paths can fit, and
    # clips that are not here are no mistake.
    own = [row for row in rows if not row.catalogue]
    prefix = names.prefix_of([row.file or row.id for row in own])
    for row in rows:
        matches.match(row, prefix)
    if prefix:
        notes.append(
            f"captions name files in '{prefix}', which the source does not have: it is taken for that"
        )
    notes += [f"{row.where}: {matches.refused[row.id]}" for row in own if row.id in matches.refused]
    found = matches.found
    missing = matches.missing
    # Split files may use the ids that the captions give to files.
    for path, row in found.items():
        names.call(row.id, path)
    splits: dict[str, Split] = {}
    prefix = names.prefix_of(list(listed.splits)) if listed else ""
    if prefix:
        notes.append(
            f"split files name files in '{prefix}', which the source does not have: it is taken for that"
        )
    for name, split in listed.splits.items() if listed else ():
        place, refused = names.find(name, prefix)
        if refused:
            raise UserError(f"{split}.txt: {refused}")
        matches.files.setdefault(name, place or "")
        if place is None:
            missing.setdefault(name, bare(name))
        elif splits.setdefault(place, split) != split:
            raise UserError(
                f"'{name}' in {split}.txt means {place}, which is in {splits[place]}.txt too; that leaks"
            )
    # An empty split would train, or test, on nothing without a word.
    for split in dict.fromkeys(listed.splits.values() if listed else ()):
        if split not in splits.values():
            raise UserError(f"{split}.txt: none of its clips is in the source, so the split would be empty")
    free = tuple(path for path in paths if path not in found)
    lines = [replace_line(line, matches) for row in rows for line in row.lines]
    lines += [replace_line(line, matches) for line in (listed.lines if listed else ())]
    return Listing(found, None if listed is None else splits, missing, matches.unused, free, notes, lines)


def replace_line(line: ListLine, matches: _Matches) -> ListLine:
    """The line with the file of its clip for the clip's name, and why it says nothing of one."""
    reason = line.reason or matches.refused.get(line.key, "")
    return line._replace(key=matches.files.get(line.key) or line.key, reason=reason)


def _stem(name: str) -> str:
    return bare(name).rsplit("/", 1)[-1].lower()


_SHOWN = 3
"""Names that a sentence lists."""


def _listed(given: object) -> object:
    """One place as several; `~` is the home folder."""
    places = given if isinstance(given, list | tuple) else [] if given is None else [given]
    return [Path(place).expanduser() if isinstance(place, str | Path) else place for place in places]


class CaptionConfig(ConvertConfig):
    """Options of converters that take captions in any form."""

    captions: Annotated[
        tuple[Path, ...], BeforeValidator(_listed, json_schema_input_type=Path | tuple[Path, ...] | None)
    ] = ()
    """Captions by the clips' names: JSON lines, JSON, CSV, TSV, CMU's or KIT-ML's lists, or a folder of these
    and of .txt files (docs/sources.md); several count together. Columns of other names stand behind the file:
    `takes.csv:text=Beschreibung,file=Datei`. Without it clips have no captions.
    """
    splits: Path | None = None
    """Folder of train.txt, val.txt, test.txt, or `subjects` for all clips of a person in one split, by a hash
    of the name (`subjects:3` by another one, `clips:3` by each id); else the captions' `split`, else `clips`.
    """
    uncaptioned: Literal["stop", "drop", "keep"] = "stop"
    """Clips that the given captions do not name: stop and say which, leave them out, or keep them.
    """

    @property
    def has_captions(self) -> bool:
        """Whether captions are given."""
        return bool(self.captions)

    def options(self) -> dict[str, object]:
        """Return the fields that the output depends on; `stop` counts as `drop`: both write captions."""
        return super().options() | {"uncaptioned": "drop" if self.uncaptioned == "stop" else self.uncaptioned}

    def listing(self, paths: Sequence[str]) -> Listing:
        """Return the captions and splits of motion files, by their paths in the source."""
        captions = Captions.read(self.captions)
        rule = None if self.splits is None or self.splits.exists() else SplitRule.parse(str(self.splits))
        listed = read_split_files(self.splits) if self.splits and not rule else None
        notes = [*(listed.notes if listed else ()), *unused_files(self.source, paths, captions)]
        found = list_clips(paths, captions.rows.values(), listed, notes)
        bad = [bad_line(sentence) for sentence in captions.bad]
        return replace(found, rule=rule, lines=[*found.lines, *bad])


def bad_line(sentence: str) -> ListLine:
    """The line that a sentence, which begins with its place, refuses."""
    found = re.match(r"(.*?:\d+):? (.*)", sentence)
    place, reason = (found[1], found[2]) if found else (sentence.partition(": ")[0], sentence)
    return ListLine(place.rsplit("/", 1)[-1], "", reason)


def unused_files(source: Path, paths: Sequence[str], captions: Captions) -> list[str]:
    """Return notes on unread files that look like captions, and on given tables that hold none."""
    notes = []
    if captions.bad:
        count = len(captions.bad)
        notes.append(f"{count:,} records of captions cannot be read: {'; '.join(captions.bad[:_SHOWN])}")
    if captions.others:
        notes.append(f"no captions in {_some([path.name for path in captions.others])}")
    if source.is_dir():
        texts, tables = caption_files(source)
        stems = set(map(bare, paths))
        found = [text for text in texts if text.relative_to(source).as_posix().removesuffix(".txt") in stems]
        unread = [path for path in [*found, *tables] if str(path.absolute()) not in captions.used]
        unread = [path for path in unread if path.suffix == ".txt" or holds_captions(path, {})]
        if unread:
            names = _some([path.relative_to(source).as_posix() for path in unread])
            notes.append(
                f"{len(unread)} files of captions in the source are not used: {names}; add --captions"
            )
    return notes


def digest_of(given: Path) -> str:
    """Checksum of a file, or of those in a folder that hold captions or maps; empty for anything else."""
    path, _ = place_of(given)
    if path.is_dir():
        texts, tables = caption_files(path)
        inside = {file.relative_to(path).as_posix(): sha256_of(file) for file in sorted([*texts, *tables])}
        return sha256_of_json(inside) if inside else ""
    return sha256_of(path) if path.is_file() else ""


def settle_captions(config: CaptionConfig, draft: ConversionPlan[C], found: Listing) -> None:
    """Note in the plan how captions and clips fit; `draft.stop` says why conversion must not start."""
    for name, clip_id in found.missing.items():
        reason = f"clip '{clip_id}' is listed, but its file is not in the source"
        draft.mark_missing(name, reason, clip_id)
    draft.known.lines += found.lines
    draft.notes += found.empty_splits({clip.label(): split for split, clip in draft.items})
    if not config.captions:
        return
    bare_clips = draft.words.bare
    captioned = draft.words.captioned
    places = [place_of(place)[0] for place in config.captions]
    file = ", ".join(place.name for place in places)
    total = captioned + len(bare_clips)
    become = {"stop": "", "drop": " and are left out", "keep": " and are kept"}[config.uncaptioned]
    sentences = [f"{captioned} of {total} clips have captions in {file}"]
    if bare_clips:
        sentences.append(f"{len(bare_clips)} have none{become} ({_some(bare_clips)})")
    if found.unused:
        sentences.append(f"captions for {_unused(found)}")
    draft.words.summary = "; ".join(sentences)
    draft.notes.append(draft.words.summary)
    if bare_clips and config.uncaptioned == "stop":
        draft.stop = (
            f"{', '.join(map(str, places))}: no captions for {len(bare_clips)} of {total} clips "
            f"({_some(bare_clips)})"
            + (f"; captions for {_unused(found)}" if found.unused else "")
            + "; add them, or choose --set uncaptioned=drop, which leaves these clips out, or "
            "uncaptioned=keep, which converts them without words"
        )


def _some(names: list[str]) -> str:
    more = f", and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


def _unused(found: Listing) -> str:
    """Count the clips that have captions and no file, and name the first with the nearest names."""
    if all(row.catalogue for row in found.unused):
        return f"{len(found.unused)} clips of its collection that are not in the source"
    shown = []
    stems = {_stem(path): path for path in sorted(found.free, reverse=True)}
    for name in (row.file or row.id for row in found.unused[:_SHOWN]):
        near = [stems[stem] for stem in difflib.get_close_matches(_stem(name), list(stems), n=2)]
        shown.append(f"'{name}'" + (f", nearest: {' and '.join(near)}" if near else ""))
    more = f"; and {len(found.unused) - _SHOWN} more" if len(found.unused) > _SHOWN else ""
    which = "clip that is" if len(found.unused) == 1 else "clips that are"
    return f"{len(found.unused)} {which} not in the source ({'; '.join(shown)}{more})"
