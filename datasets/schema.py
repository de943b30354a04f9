"""Typed records at the project's borders: configs, captions, clip metadata, the shard manifest.

Everything read from outside (YAML recipes, `meta.json`, `manifest.json`) passes through one of these models,
so a misspelt key or a wrong type is refused in one sentence that names the file, the key and the nearest
valid name.
"""

from __future__ import annotations

import difflib
import json
import math
import re
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal, Self, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, ValidationError

SCHEMA_VERSION = 3

HANDS, FACE = 1, 2
"""Bits of what a clip has beside its body."""
PRESENT_ALL = HANDS | FACE

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
MotionType = Literal["float32", "float16"]
"""Number type of motion in shards."""

MANIFEST_FILE, INDEX_FILE = "manifest.json", "index.npz"
"""In the folder of a data set, beside its shards."""
CLEANED_FILE = "cleaned.json"
"""Beside them where somebody has cleaned the set."""
REMOVED_FILE = "removed.json"
"""Beside them where clips were removed from the set."""


_LONGEST = 2000
"""Characters of a line of a `UserError`: names and numbers of strangers in it may have any length."""


class UserError(Exception):
    """A mistake the user can fix. The command line prints the sentence alone, never a traceback.

    What a terminal or a log would obey is written out, and the middle of an endless line is left out.
    """

    def __init__(self, words: str = "") -> None:
        lines, half = [], _LONGEST // 2
        for line in words.split("\n"):
            if not line.isprintable():
                line = "".join(c if c.isprintable() else repr(c)[1:-1] for c in line)
            lines.append(line if len(line) <= _LONGEST else f"{line[:half]} … {line[-half:]}")
        super().__init__("\n".join(lines))


def nearest(name: str, valid: Sequence[str], shown: Sequence[str] | None = None, what: str = "names") -> str:
    """A hint to append: did you mean 'x'?, or the list of valid names, or else of those `shown`."""
    near = difflib.get_close_matches(name, valid, n=1, cutoff=0.5)
    names = valid if shown is None else shown
    return f"; did you mean '{near[0]}'?" if near else f"; valid {what}: {', '.join(names)}"


def require_local(place: object) -> None:
    """Refuse a URL where a path is wanted: as a path, `s3://bucket/x` is a folder named `s3:`.

    `place` may be anything: of lists and configs all paths are looked at, of what else there is nothing.
    """
    if isinstance(place, Path):
        if found := re.match(r"([A-Za-z][A-Za-z0-9+.-]+):/", str(place)):
            raise UserError(
                f"{found[1]}://{str(place)[found.end() :].lstrip('/')}: no URL is read or written here, only "
                f"this machine's files; `motionloom data copy` carries data sets there and back, and stages "
                f"of kind `shards` read them there"
            )
    elif isinstance(place, list | tuple | Config):
        for one in place.__dict__.values() if isinstance(place, Config) else place:
            require_local(one)


MOST_JSON_BYTES = 2**28
"""Larger JSON files are refused unread: the manifest of a million clips has a few megabytes."""


def read_plain(path: Path, most: int = MOST_JSON_BYTES, name: str = "") -> bytes:
    """Content of a plain file of at most `most` bytes; `UserError` for anything else, such as a device or a
    pipe, which would be read without end. `FileNotFoundError` when there is none. Errors name it by its path,
    or by `name`.
    """
    size = require_plain(path, name)
    if size > most:
        raise UserError(f"{name or path}: {size:,} bytes; at most {most:,} are read")
    return path.read_bytes()


def open_plain(path: Path, name: str = "") -> BinaryIO:
    """Open a file of others for reading; `UserError` at once for what `require_plain` refuses."""
    require_plain(path, name)
    return path.open("rb")


def require_plain(path: Path, name: str = "") -> int:
    """Bytes of a plain file; `UserError` for a device or a pipe, which would be waited for without end."""
    about = path.stat()
    if not stat.S_ISREG(about.st_mode):
        raise UserError(f"{name or path}: not a plain file")
    return about.st_size


_HALF_LETTER = re.compile(r"\\u[dD][89a-fA-F]")
"""Begins the escape of a surrogate, which with another makes a letter."""


def parse_json(raw: str | bytes, where: str, **how: Any) -> Any:
    """Return JSON decoded, with `how` as for `json.loads`; `UserError` beginning with `where` otherwise.

    All JSON from outside comes through here: numbers are finite, whole ones of 64 bits, and no text holds
    half of a letter, which nothing can be written with. `RecursionError` bounds the depth.
    """
    try:
        text = raw.decode() if isinstance(raw, bytes) else raw
        found = json.loads(text, parse_float=_finite, parse_int=_of_64_bits, parse_constant=_finite, **how)
        (json.dumps(found, ensure_ascii=False) if _HALF_LETTER.search(text) else text).encode()
    except UnicodeEncodeError:
        raise UserError(f"{where}: not valid JSON (half of a letter, a lone surrogate)") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{where}: not valid JSON ({error or 'too deep'})") from None
    return found


def _finite(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(f"{text:.20} is not a finite number")
    return value


def _of_64_bits(text: str) -> int:
    if len(text) > 20 or not -(2**63) <= (value := int(text)) < 2**63:
        raise ValueError(f"{text:.20} is beyond 64 bits")
    return value


MOST = 1e9
"""No count of frames and no time in seconds is larger."""


def number(value: object, where: str, most: float = MOST, least: float = 0) -> float:
    """Return the number of a field; a `UserError` begins with `where`, also beyond `least` to `most`."""
    try:
        plain = not isinstance(value, str) or (value.isascii() and "_" not in value)
        found = float(value) if plain and isinstance(value, str | int | float) else math.nan
    except (ValueError, OverflowError):
        found = math.nan
    if not least <= found <= most:
        raise UserError(f"{where}: '{value!s:.20}' is no number from {least:g} to {most:g}")
    return found


def whole(value: object, where: str, most: float = MOST, least: float = 0) -> int:
    """The same of a whole number, such as one of frames."""
    if (found := number(value, where, most, least)) % 1:
        raise UserError(f"{where}: '{value!s:.20}' is no whole number")
    return int(found)


FrameRate = Annotated[float, Field(ge=0.1, le=1000)]
"""Frames a second of a motion."""


class Config(BaseModel):
    """Base of every config class and record: unknown keys, wrong types and numbers that are not finite are
    refused, values are frozen."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, validate_default=True, defer_build=True, allow_inf_nan=False
    )

    @classmethod
    def parse(cls, data: Any, where: str) -> Self:
        """Validate `data`; a `UserError` names `where` (a file or a dotted key) and the nearest name."""
        try:
            made = cls.model_validate(data)
        except ValidationError as error:
            raise UserError(explain(error, cls, where)) from None
        require_local(made)
        return made

    @classmethod
    def load_json(cls, path: Path) -> Self:
        """Read one record from a JSON file."""
        try:
            raw = read_plain(path)
        except FileNotFoundError:
            raise UserError(f"{path}: no such file") from None
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error})") from None
        return cls.parse(parse_json(raw, str(path)), str(path))

    def dump(self) -> dict[str, Any]:
        """Plain JSON types, every default written out."""
        return self.model_dump(mode="json")


def explain(error: ValidationError, model: type[BaseModel], where: str) -> str:
    """One line per problem, with the nearest valid key for each unknown one."""
    lines = []
    for item in error.errors():
        loc = [str(part) for part in item["loc"]]
        key = ".".join(loc) or "(top level)"
        if item["type"] == "extra_forbidden":
            names = field_names(model, loc[:-1])
            lines.append(f"{where}: unknown key '{key}'{nearest(loc[-1], sorted(names), what='keys')}")
        elif item["type"] == "missing":
            lines.append(f"{where}: key '{key}' is required")
        else:
            message = item["msg"].removeprefix("Value error, ")
            shown = f"key '{key}' = {item.get('input')!r:.60}: " if loc else ""
            lines.append(f"{where}: {shown}{message}")
    return "\n".join(lines)


def field_names(model: type[BaseModel], path: list[str]) -> list[str]:
    """Valid keys of the model at `path`, also of one in a list; unions of several are not followed."""
    current: Any = model
    for part in path:
        fields = getattr(current, "model_fields", {})
        if part in fields:
            current = _model_in(fields[part].annotation)
        elif not part.isdecimal():  # a place in a list of what is current already
            return list(fields)
    return list(getattr(current, "model_fields", {}))


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The one model that a field's type is or holds."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    found = {model for inner in get_args(annotation) if (model := _model_in(inner)) is not None}
    return found.pop() if len(found) == 1 else None


# Readers that infer columns from the first rows (Arrow, so Hugging Face `datasets`) refuse a field that is
# null or of other keys there and filled later: what a clip does not have is stored as a value of its type.
_Text = Annotated[
    str | None, BeforeValidator(lambda text: text or None), PlainSerializer(lambda text: text or "")
]
"""None is stored as empty text."""
_Written = Annotated[
    str, BeforeValidator(lambda text: str(text).encode("utf-8", "backslashreplace").decode())
]
"""Bytes of a file's name that are no UTF-8, lone surrogates here, are stored as `\\udc8f`."""
_End = Annotated[
    Annotated[float, Field(le=MOST)] | None,
    BeforeValidator(lambda end: None if end == -1 else end),
    PlainSerializer(lambda end: -1.0 if end is None else end),
]
"""None is stored as -1."""
_Tokens = Annotated[
    list[str] | None,
    BeforeValidator(lambda tokens: (tokens.split() if isinstance(tokens, str) else tokens) or None),
    PlainSerializer(lambda tokens: " ".join(tokens or ())),
]
"""Stored as one text with spaces between, as HumanML3D has them; None is empty text."""
_Record = Annotated[
    dict[str, Any] | None,
    BeforeValidator(lambda record: parse_json(record or "null", "truth") if type(record) is str else record),
    PlainSerializer(lambda record: "" if record is None else json.dumps(record, allow_nan=False)),
]
"""Stored as JSON text, since the keys of one clip are not another's; None is empty text."""


class Caption(Config):
    """One caption of a clip. `start`/`end` are seconds; `end` None means to the end of the clip."""

    text: str
    start: float = Field(0.0, le=MOST)
    end: _End = None
    source: str = ""
    tokens: _Tokens = None
    """`word/POS` tags where the source brings them (HumanML3D)."""


class ClipMeta(Config):
    """`meta.json` of one sample: where a clip comes from and what its features mean.

    `MotionLayout.clip_meta` makes one and fills in what the layout knows.
    """

    id: str
    source: str
    split: Split
    layout: str
    family: Literal["exact", "h3d", "raw"]
    fps: FrameRate
    skeleton: str
    frames: int
    licence: str
    has_hands: bool = True
    has_face: bool = True
    mirror_of: _Text = None
    truth: _Record = None
    """True content of a synthetic clip (action, direction, side, count, hand, face)."""
    song: _Text = None
    """The piece of music of a recorded dance, by the source's name; several clips may have one."""

    @property
    def present(self) -> int:
        """`has_hands` and `has_face` as bits."""
        return HANDS * self.has_hands | FACE * self.has_face


class ShardInfo(Config):
    """One tar file of the manifest."""

    name: str
    split: Split
    samples: int
    frames: int
    bytes: int
    sha256: str


class Dropped(Config):
    """A source clip that did not become a sample, and why."""

    source: _Written
    reason: _Written
    kind: Literal["rejected", "unreadable", "missing"] = "rejected"
    """`rejected`: it is in the source, but cannot or must not become a sample. `unreadable`: a file, of
    motion or of texts, that is damaged. `missing`: listed somewhere, but not in the source."""


class Manifest(Config):
    """`manifest.json` beside the shards; written last, so a folder without one is unfinished."""

    schema_version: int = SCHEMA_VERSION
    name: str
    layout: str
    family: Literal["exact", "h3d", "raw"]
    fps: FrameRate
    skeleton: str
    licence: str
    converter: str
    converter_version: int
    options: dict[str, Any]
    shards: list[ShardInfo]
    dropped: list[Dropped] = []
    licences: dict[str, int] = {}
    """Clips under each licence, for sources that mix several."""
    credits: list[str] = []
    """Sentences that these licences ask for, wherever the data or what was made from it is shown."""
    audio: dict[str, Any] | None = None
    """Settings the audio features were made with; a model trained on them keeps these."""
    notes: list[str] = []
    excluded: dict[str, str] = {}
    """Ids of clips that readers skip, and why: what `motionloom data clean` was told to leave out."""


class Decisions(Config):
    """`cleaned.json`, and what the page of `motionloom data clean` saves: verdicts about suspect clips."""

    left_out: dict[str, str] = {}
    """Id of a clip -> why."""
    kept: tuple[str, ...] = ()
    """Ids of suspects that are good, which nobody is asked about again."""

    @classmethod
    def of(cls, root: Path) -> Decisions:
        """Read the decisions about a data set; none where it has no file of them."""
        path = root / CLEANED_FILE
        return cls.load_json(path) if path.is_file() else cls()

    def then(self, later: Decisions) -> Decisions:
        """These and `later` ones, which count where a clip is in both."""
        left_out = {clip: why for clip, why in self.left_out.items() if clip not in later.kept}
        left_out |= later.left_out
        return Decisions(left_out=left_out, kept=tuple(sorted({*self.kept, *later.kept} - {*left_out})))
