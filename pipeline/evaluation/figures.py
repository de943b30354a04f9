"""A figure: one number that was measured, with all that one must know to read it.

An evaluation writes a list of them (`metrics.json`). The terminal, the report, the papers' tables
and JSON output filter that list; none of them knows a metric by name. Numpy is not imported here, so that
reading takes no time.

Two figures of one name were measured alike exactly when their protocols are equal, and only then are they
ranked. The protocol holds the clips (by digest), what judged them, among how many candidates, how motions
were drawn and how often; the seed of the draws is no part of it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import parse_json, read_plain
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.yaml import flatten, setting_text

if TYPE_CHECKING:
    from rich.console import Console

FILE_NAME = "metrics.json"
VERSION = 1
"""Raised when a figure keeps its name and changes its meaning; figures of other versions are refused."""
DIGITS = 5

Better = Literal["lower", "higher", ""]
Fact = str | int | float | bool | None
Protocol = Mapping[str, Fact]

MODEL = ""
"""The row of what is evaluated; all other rows are reference baselines, and are never ranked."""
RECORDED = "recorded motion"
THROUGH = "recorded motion, through the tokenizer"
"""The best that a generator of its tokens can be."""
TRAINING = "training clips, as many"
NEAREST = "nearest training clip"
OWN_CAPTION = "another caption of the clip, by the rest"
COMMON_CAPTION = "most frequent training caption"
NEAREST_WORDS = "nearest training caption"
NEAREST_LABELS = "nearest training labels"
NEAREST_MUSIC = "training dance to the nearest music"
RANDOM_DANCE = "random training dance"
OTHER_MUSIC = "generated dances under other music"
STILL = "mean pose, still"
MEAN_FACE = "mean expression"
CHANCE = "chance"
TableRows = tuple[str, list[str], list[list[str]]]
"""Title, columns and rows of a table."""
ROWS = (
    MODEL, RECORDED, THROUGH, NEAREST_WORDS, NEAREST_LABELS, TRAINING, NEAREST, NEAREST_MUSIC,
    RANDOM_DANCE, OTHER_MUSIC, OWN_CAPTION, COMMON_CAPTION, STILL, MEAN_FACE, CHANCE,
)  # fmt: skip
"""In the order in which they are shown."""


_DIGESTS = {"clips_sha256": "clips", "judge": "judges"}
"""Facts whose values say nothing to people."""


@dataclass(frozen=True)
class Estimate:
    """A value and half of its 95 % interval (`estimate.py`)."""

    value: float
    interval: float | None = None
    over: str = ""
    """The units that the interval is over: clips or repeats."""
    count: int = 0
    """Clips that it is a mean over; 0 of a figure of the whole set."""
    pair: tuple[float, ...] = ()
    """Both values where two repeats were all: two say nothing of a spread."""


@dataclass(frozen=True)
class Metric:
    """A column: the name of its figures, its title, which direction is better, and the unit."""

    name: str
    title: str
    better: Better = ""
    unit: str = ""
    """"share" is shown in percent."""


FEW = 10
"""Clips below which a figure says nothing, and candidates up to which a retrieval does not **[ours]**."""
DASH = "–"
_NOTHING_SAID = 0.5
"""Half of an interval of a share from which it may be nearly anything."""


@dataclass(frozen=True)
class Figure:
    """A measured number with its interval, unit and protocol."""

    name: str
    value: float
    interval: float | None = None
    """Half of the 95 % interval; None where nothing was repeated."""
    unit: str = ""
    better: Better = ""
    row: str = MODEL
    protocol: Protocol = field(default_factory=dict)
    group: str = ""
    """The table that it is shown in. All figures of a group have one protocol."""
    title: str = ""
    """Title of its column in that table."""
    over: str = ""
    """The units that the interval is over: clips or repeats."""
    note: str = ""
    """Why the figure is not to be trusted."""
    count: int = 0
    """Clips that it is a mean over; 0: all of the protocol."""
    pair: tuple[float, ...] = ()
    """Both values where two repeats were all."""

    @property
    def nothing(self) -> str:
        """Why it is shown as a dash, where it says nothing; else empty."""
        if int(self.count or self.protocol.get("clips") or FEW) < FEW:
            return f"of fewer than {FEW} clips"
        if int(among := self.protocol.get("candidates") or FEW + 1) <= FEW:
            return f"among {among}, which tells nothing"
        if self.unit == "share" and (self.interval or 0.0) >= _NOTHING_SAID:
            return f"too few {self.over}"
        return ""

    def text(self) -> str:
        """The value with its interval, both values of two repeats, or a dash, for people."""
        if self.nothing:
            return DASH
        if self.pair:
            return " / ".join(number(value, self.unit) for value in self.pair)
        value = number(self.value, self.unit)
        return value if self.interval is None else f"{value} ± {number(self.interval, self.unit)}"

    @property
    def protocol_key(self) -> str:
        """Figures of one name whose keys are equal were measured alike."""
        return json.dumps(dict(self.protocol), sort_keys=True)


def number(value: float, unit: str = "") -> str:
    """One decimal of mm, whole percents of shares, else three decimals; four digits of large numbers."""
    if unit == "share":
        return f"{100 * value:.0f} %"
    if unit == "mm":
        return f"{value:.1f}"
    return f"{value:.4g}" if abs(value) >= 100 else f"{value:.3f}"


def group_figures(
    group: str,
    metrics: Sequence[Metric],
    rows: Mapping[str, Mapping[str, Estimate]],
    protocol: Protocol,
    notes: Mapping[str, str] | None = None,
    *,
    prefix: str = "",
) -> list[Figure]:
    """The figures of one table: row -> name of a metric -> its estimate; what a row lacks is left out.

    `notes` says by the name of a metric why its figures are not to be trusted; `prefix` begins their names.
    """
    out = []
    for row, estimates in rows.items():
        for metric in metrics:
            found = estimates.get(metric.name)
            if found is None or not math.isfinite(found.value):
                continue
            name = f"{prefix}{metric.name}"
            note = (notes or {}).get(metric.name, "")
            shown = (metric.unit, metric.better, row, protocol, group, metric.title)
            last = (found.over, note, found.count, found.pair)
            out.append(Figure(name, found.value, found.interval, *shown, *last))
    return out


def facts(values: Mapping[str, Any]) -> dict[str, Fact]:
    """Settings as a protocol has them: dotted keys, plain values."""
    flat = flatten(values)
    return {k: v if isinstance(v, Fact) else setting_text(v) for k, v in flat.items()}


def decodings_of(protocol: Protocol) -> int:
    """Decodings of each draw of tokens."""
    return int(protocol.get("decodings") or 1)


@dataclass(frozen=True)
class FigureFile:
    """The figures that an evaluation has written, and the stages that they are about."""

    kind: str
    """The kind of evaluation: evaluate, evaluate_dances, retrieval."""
    figures: tuple[Figure, ...]
    about: Mapping[str, Any] = field(default_factory=dict)
    """Stages evaluated and judges, by role, with their checksums, and the seed."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """Where the model errs (`diagnosis.py`)."""

    def of(self, name: str, row: str = MODEL) -> Figure | None:
        """One figure; None where it was not measured."""
        return next((one for one in self.figures if one.name == name and one.row == row), None)

    def write(self, path: Path) -> None:
        """Write it as JSON, numbers rounded."""
        data: dict[str, object] = {"version": VERSION, "kind": self.kind, "about": self.about}
        data["protocol"] = {one.group: dict(one.protocol) for one in self.figures}
        data["figures"] = [_entry(one) for one in self.figures]
        write_json(path, data | ({"details": self.details} if self.details else {}))

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read it again; a `UserError` names what is wrong with the file."""
        try:
            data = parse_json(read_plain(path), str(path), parse_constant=float)
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror}); evaluate again") from None
        except UserError as error:
            raise UserError(f"{error}; evaluate again") from None
        if not isinstance(data, dict):
            raise UserError(f"{path}: holds no JSON object; evaluate again")
        if data.get("version") != VERSION:
            raise UserError(
                f"{path}: version {data.get('version')}, whose figures meant something else than those of "
                f"version {VERSION}; evaluate again"
            )
        try:
            protocols = data["protocol"]
            figures = tuple(
                Figure(**one | {"protocol": protocols[one["group"]], "pair": tuple(one.get("pair", ()))})
                for one in data["figures"]
            )
            file = cls(str(data["kind"]), figures, dict(data["about"]), dict(data.get("details", {})))
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{path}: not as an evaluation writes it ({error}); evaluate again") from None
        for one in figures:
            if not all(map(_is_number, (one.value, one.interval or 0, one.count, *one.pair))):
                raise UserError(f"{path}: figure '{one.name}' is no number; evaluate again")
        return file


def _entry(figure: Figure) -> dict[str, object]:
    """A figure as the file has it: its protocol stands under its group, what is empty is left out."""
    pair = tuple(round(float(value), DIGITS) for value in figure.pair)
    rounded = replace(figure, value=round(float(figure.value), DIGITS), pair=pair)
    if figure.interval is not None:
        rounded = replace(rounded, interval=round(float(figure.interval), DIGITS))
    out = {key: value for key, value in asdict(rounded).items() if value not in ("", None, ())}
    del out["protocol"]
    return out


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def figure_tables(figures: Iterable[Figure]) -> list[TableRows]:
    """A table for each group of figures; the terminal and the report show the same ones."""
    groups: dict[str, list[Figure]] = {}
    for figure in figures:
        groups.setdefault(figure.group, []).append(figure)
    return [_table(group, members) for group, members in groups.items()]


def _table(group: str, figures: Sequence[Figure]) -> TableRows:
    columns: dict[str, str] = {}
    found: dict[str, dict[str, Figure]] = {}
    for one in figures:
        columns.setdefault(one.name, f"{one.title}{_unit(one)}")
        found.setdefault(one.row, {})[one.name] = one
    rows = [
        [row or "model", *(found[row][name].text() if name in found[row] else "" for name in columns)]
        for row in sorted(found, key=lambda row: ROWS.index(row) if row in ROWS else len(ROWS))
    ]
    return "; ".join([group, *_remarks(figures)]), ["", *columns.values()], rows


def _unit(figure: Figure) -> str:
    """The unit behind the title of a column; shares have theirs in each value."""
    return "" if figure.unit in ("", "share") else f", {figure.unit}"


def print_summary(figures: Sequence[Figure], console: Console) -> None:
    """A line for each table on a terminal: its first figure, and the first row beside it that has one."""
    from rich.markup import escape
    from rich.table import Table

    tables: dict[str, dict[str, Figure]] = {}
    for one in figures:
        rows = tables.setdefault(one.group, {one.row: one})
        if one.name == next(iter(rows.values())).name:
            rows.setdefault(one.row, one)
    lines = Table("    figure", "model", "beside it", box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for found in tables.values():
        first = next(iter(found.values()))
        beside = next((row for row in ROWS[1:] if row in found), None)
        model = found[MODEL].text() if MODEL in found else DASH
        reference = "" if beside is None else f"{found[beside].text()} {beside}"
        lines.add_row(*map(escape, (f"    {first.name}{_unit(first)}", model, reference)))
    console.print(lines)
    for reason in dict.fromkeys(one.nothing for one in figures if one.nothing):
        console.print(f"    {DASH}: {reason}")


def print_tables(figures: Iterable[Figure], console: Console) -> None:
    """All tables on a terminal."""
    from rich.markup import escape
    from rich.table import Table

    for title, columns, rows in figure_tables(figures):
        table = Table(*map(escape, columns), title=escape(title), title_justify="left")
        for row in rows:
            table.add_row(*map(escape, row))
        console.print(table)


def say_difference(protocols: Mapping[str, Protocol]) -> str:
    """A sentence on how the protocols of figures, by label, differ; empty where they are equal."""
    parts = []
    for name in dict.fromkeys(name for protocol in protocols.values() for name in protocol):
        values = {label: protocol.get(name) for label, protocol in protocols.items()}
        if len({json.dumps(value) for value in values.values()}) > 1:
            shown = "; ".join(f"{label}: {value}" for label, value in values.items())
            parts.append(f"different {_DIGESTS[name]}" if name in _DIGESTS else f"{name} ({shown})")
    return f"Not all measured alike, so not all ranked: {', '.join(parts)}." if parts else ""


def _remarks(figures: Sequence[Figure]) -> list[str]:
    """Remarks on a group of figures: clips, candidates, intervals, and notes on figures not to be trusted."""
    protocol = figures[0].protocol
    out = (
        [f"{protocol['clips']} {protocol.get('split', '')} clips".replace("  ", " ")]
        if "clips" in protocol
        else []
    )
    out += [f"among {protocol['candidates']}"] if "candidates" in protocol else []
    shown = [one for one in figures if not one.nothing]
    overs = list(dict.fromkeys(one.over for one in shown if one.interval is not None))
    out += [f"± 95 % over {' or '.join(overs)}"] if overs else []
    out += ["a / b: both repeats"] if any(one.pair for one in shown) else []
    out += [f"{DASH}: {why}" for why in dict.fromkeys(one.nothing for one in figures if one.nothing)]
    notes: dict[str, dict[str, None]] = {}
    for one in shown:
        if one.note:
            notes.setdefault(one.note, {})[one.title] = None
    return out + [f"{' and '.join(titles)}: {note}" for note, titles in notes.items()]
