"""The records of a data set: captions, facts of clips, the manifest, decisions about clips.

Everything read from outside (`meta.json`, `manifest.json`) passes through one of these models.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BeforeValidator, Field, PlainSerializer

from motionloom.datasets.base.config import Config, FrameRate
from motionloom.datasets.base.files import sha256_of_json
from motionloom.datasets.base.json_doors import MOST, parse_json

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
COLUMNS, COLUMN_FILE = "columns", "column.json"
"""Folder of the columns that were added to the set; in the folder of each there is its record."""

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
    PlainSerializer(lambda end: -1.0 if end is None else end, return_type=float),
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


class Fault(Config):
    """One thing that is wrong with a clip."""

    kind: str
    text: str
    """The measured value and its bound, in one phrase."""
    weight: float
    """The measure over its bound: above 1."""
    frame: int = 0
    """The frame that shows it best."""


_Faults = Annotated[
    tuple[Fault, ...] | None,
    BeforeValidator(lambda found: parse_json(found or "null", "faults") if type(found) is str else found),
    PlainSerializer(
        lambda found: (
            "" if found is None else json.dumps([one.model_dump() for one in found], allow_nan=False)
        )
    ),
]
"""Stored as JSON text; None, where nobody has judged a clip, is empty text."""


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
    faults: _Faults = None
    """What the judge of motion found at the source's frame rate; None where no source was judged."""
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


class Column(Config):
    """A column that was added beside a set's clips: one more member of each, in a tar beside each shard."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]{0,39}$")
    member: str
    """`NAME.json` holds captions, `NAME.npy` numbers."""
    shards: list[ShardInfo]
    """Its tars, in the order of the manifest's shards; each has the keys of its shard."""
    beside: str
    """Digest of the shards that it was made for."""
    index: str
    """sha256 of its `index.npz`."""
    clips: int
    """Clips with a value."""
    gone: int = 0
    """Values that no clip of the set has, or has any more."""

    def file(self, name: str) -> str:
        """A file of its folder, as seen from the set's."""
        return f"{COLUMNS}/{self.name}/{name}"

    def tars(self, split: Split) -> list[ShardInfo]:
        """Its tars of a split."""
        return [tar for tar in self.shards if tar.split == split]

    def feeds(self, member: str) -> bool:
        """Whether its values are those of a clip's member: all captions are, but for `face_texts`."""
        is_text = self.member.endswith(".json") and self.name != "face_texts"
        return member == ("texts.json" if is_text else self.member)

    def fits(self, shards: Sequence[ShardInfo]) -> bool:
        """Whether it was made for these shards."""
        own = [(shard.name, shard.split, shard.samples) for shard in self.shards]
        wanted = [(self.file(shard.name), shard.split, shard.samples) for shard in shards]
        return self.beside == beside(shards) and own == wanted


def beside(shards: Sequence[ShardInfo]) -> str:
    """The digest of shards that a column is made for."""
    return sha256_of_json([[shard.name, shard.sha256] for shard in shards])


class Dropped(Config):
    """A source clip that did not become a sample, and why."""

    source: _Written
    reason: _Written
    kind: Literal["rejected", "unreadable", "missing", "not ours"] = "rejected"
    """`rejected`: it is in the source, but cannot or must not become a sample. `unreadable`: a file, of
    motion or of texts, that is damaged. `missing`: listed somewhere, but not in the source.
    `not ours`: in the source, but not read (in the list beside the shards alone)."""


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
    dropped: list[Dropped] = Field(default_factory=list)
    licences: dict[str, int] = Field(default_factory=dict)
    """Clips under each licence, for sources that mix several."""
    credits: list[str] = Field(default_factory=list)
    """Sentences that these licences ask for, wherever the data or what was made from it is shown."""
    audio: dict[str, Any] | None = None
    """Settings the audio features were made with; a model trained on them keeps these."""
    notes: list[str] = Field(default_factory=list)
    excluded: dict[str, str] = Field(default_factory=dict)
    """Ids of clips that readers skip, and why: what `motionloom data clean` was told to leave out."""
    columns: list[Column] = Field(default_factory=list, exclude_if=lambda columns: not columns)
    """What `motionloom data add` has put beside the shards."""

    @property
    def tars(self) -> list[ShardInfo]:
        """All tars: shards, and those of columns."""
        return [*self.shards, *(tar for column in self.columns for tar in column.shards)]


class Decisions(Config):
    """`cleaned.json`, and what the page of `motionloom data clean` saves: verdicts about suspect clips."""

    left_out: dict[str, str] = Field(default_factory=dict)
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
