"""Joint maps are data: which joints of a foreign skeleton stand for the joints of a named one.

A map file is JSON: one key named after the target skeleton holds rows `[index, target joint, source]`, where
`source` is a joint name or a list of names whose mean position is taken (a pair is the midpoint, a repeated
name weighs more); `null` is a row still to be filled in. Optional are `note`, `unmapped` (joints left out on
purpose), `unit` and `up` of the files it is for, and `skeleton`: a map with this key is for files of that
skeleton alone. The End Site of joint `Foot` is named `End Site of Foot`; `ends` places it for figures that
have none, in multiples of the distance from the joint's parent. Only positions cross the map: rest poses and
bone axes of the two skeletons differ.
Guessed ones come from `convert/bvh/joint_guess.py`.
"""

from __future__ import annotations

import difflib
import json
from codecs import BOM_UTF8
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of_json
from motionloom.datasets.base.json_doors import parse_json, read_plain
from motionloom.datasets.motion.body.retarget import SourceFigure
from motionloom.datasets.motion.bvh.motion import END, BvhMotion, channel_columns
from motionloom.datasets.motion.skeleton import Skeleton

NamedUnit = Literal["m", "cm", "mm", "inch", "dm", "foot", "inch/0.45"]
Unit = NamedUnit | Annotated[float, Field(gt=0, lt=1e6)]
"""A name, or the metres in a length of the files."""
Up = Literal["y", "z"]

METRES: dict[NamedUnit, float] = {
    "m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "dm": 0.1, "foot": 0.3048, "inch/0.45": 0.0254 / 0.45,
}  # fmt: skip
"""The last is that of CMU's recordings."""


def metres(unit: Unit) -> float:
    """Metres in a length of files in this unit."""
    return METRES[unit] if isinstance(unit, str) else unit


_UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""From Z up to Y up."""
_ROWS = TypeAdapter(list[tuple[int, str, str | list[str] | None]])


class UnfinishedMapError(UserError):
    """A map file has rows that are still to be filled in."""


class _About(Config):
    unmapped: tuple[str, ...] = ()
    skeleton: str = ""
    unit: Unit | None = None
    up: Up | None = None
    ends: dict[str, tuple[float, float, float]] = Field(default_factory=dict)


def skeleton_key(joints: Sequence[str], parents: Sequence[int]) -> str:
    """Names and parents of the joints that clips with one skeleton share. Bone lengths may differ."""
    return sha256_of_json([list(joints), list(parents)])[:16]


@dataclass(frozen=True)
class JointMap:
    """Source joints of every joint of the target skeleton."""

    where: str
    target: Skeleton
    sources: tuple[tuple[str, ...], ...]
    """Per target joint the source names whose mean is taken; none in an open row of a guess."""
    unmapped: tuple[str, ...] = ()
    skeleton: str = ""
    """`skeleton_key` of the only files that it is for; empty for all that have its joints."""
    unit: Unit | None = None
    up: Up | None = None
    """Unit of its files, where it is stated."""
    ends: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """End Sites that the files do not have, by their joints."""
    measured: bool = False
    """Whether the unit was measured on the figures, and not stated."""

    @property
    def open_rows(self) -> tuple[str, ...]:
        """Joints of the target for which a guess has no certain source."""
        return tuple(
            joint for joint, names in zip(self.target.joints, self.sources, strict=True) if not names
        )

    def doubts(self) -> str:
        """The open rows, of many the first eight."""
        more = len(self.open_rows) - 8
        return ", ".join(self.open_rows[:8]) + (f" and {more} more" if more > 0 else "")

    def read_as(self) -> list[object]:
        """Return all that positions depend on, as plain JSON: nothing of where the map came from."""
        return [self.sources, self.unit, self.up, *([dict(self.ends)] if self.ends else [])]

    @staticmethod
    def load(path: Path, *, target: str = "smpl22") -> JointMap:
        """Read the rows of skeleton `target` from a map file; every target joint must have one row."""
        try:
            raw = read_plain(path, 2**22)
        except OSError as error:
            raise UserError(f"{path}: cannot read the joint map ({error.strerror})") from None
        data = parse_json(raw.removeprefix(BOM_UTF8), str(path))
        if not isinstance(data, dict) or target not in data:
            keys = ", ".join(data) if isinstance(data, dict) else "no keys"
            raise UserError(
                f"{path}: a joint map needs a key named after the skeleton '{target}'; found {keys}"
            )
        # Rows carry index and name: a row that was moved or lost while editing by hand is found.
        skeleton = Skeleton.named(target)
        try:
            rows = _ROWS.validate_python(data[target])
        except ValidationError as error:
            at = ".".join(str(part) for part in error.errors()[0]["loc"][:1])
            raise UserError(
                f"{path}: {target} row {at}: expected [index, target joint, source joint(s)]"
            ) from None
        sources: dict[int, tuple[str, ...]] = {}
        empty = [name for _, name, source in rows if source is None]
        if empty:
            raise UnfinishedMapError(
                f"{path}: {target} rows still to be filled in (null): {', '.join(empty)}"
            )
        for index, name, source in rows:
            assert source is not None
            names = (source,) if isinstance(source, str) else tuple(source)
            if skeleton.index(name) != index:
                raise UserError(
                    f"{path}: {target} row '{name}' has index {index}, not {skeleton.index(name)}"
                )
            if index in sources or not names:
                problem = "appears twice" if index in sources else "has no source joint"
                raise UserError(f"{path}: {target} row '{name}' {problem}")
            sources[index] = names
        missing = [name for i, name in enumerate(skeleton.joints) if i not in sources]
        if missing:
            raise UserError(f"{path}: {target} has no row for {', '.join(missing)}")
        about = _About.parse({key: data[key] for key in _About.model_fields if key in data}, str(path))
        rows_in_order = tuple(sources[i] for i in range(len(skeleton)))
        return JointMap(str(path), skeleton, rows_in_order, **dict(about))

    def require_fit(self, joints: Sequence[str], clip: str) -> None:
        """`UserError` naming `clip` and the first joint of the map that `joints` lack or have twice."""
        counts = Counter([*joints, *map(END.format, dict.fromkeys(joints))])
        for name in dict.fromkeys(name for names in self.sources for name in names):
            if counts[name] == 0:
                near = difflib.get_close_matches(name, joints, n=1, cutoff=0.5)
                hint = f"did you mean '{near[0]}'?" if near else f"it has {', '.join(joints[:30])}"
                raise UserError(f"{clip}: no joint '{name}', which {self.where} names; {hint}")
            if counts[name] > 1:
                raise UserError(f"{clip}: joint '{name}' appears {counts[name]} times; the map is ambiguous")

    def apply(self, motion: BvhMotion, *, unit: Unit = "cm", up: Up = "y") -> NDArray[np.float64]:
        """World positions of the target's joints [T, N, 3] in metres, Y up.

        `unit` and `up` describe the file, which does not say them itself; the map's own count before them.
        """
        joints = self.places(motion) * metres(self.unit or unit)
        return np.asarray(joints @ _UPRIGHT.T) if (self.up or up) == "z" else joints

    def figure(self, motion: BvhMotion, *, unit: Unit = "cm", up: Up = "y") -> SourceFigure:
        """The joints with the rotations that the file gives them."""
        joints, rest = (self.apply(one, unit=unit, up=up) for one in (motion, motion.at_rest()))
        orders = [order for order, _ in channel_columns(motion.channels)[1]]
        index = {name: joint for joint, name in enumerate(motion.joints) if orders[joint]}
        known = np.array([len(names) == 1 and names[0] in index for names in self.sources])
        turns = motion.turns()[:, [index.get(names[0], 0) for names in self.sources]]
        if (self.up or up) == "z":
            turns = _UPRIGHT @ turns @ _UPRIGHT.T  # none at rest there, none here
        return SourceFigure(joints, turns, known, rest[0])

    def places(self, motion: BvhMotion) -> NDArray[np.float64]:
        """Positions of the target's joints [T, N, 3] in the lengths and axes of the file."""
        self.require_fit(motion.joints, motion.name)
        used = {name for names in self.sources for name in names}
        if not used <= set(motion.joints):
            motion = motion.with_ends(self.ends)
        world = motion.positions()
        index = {name: i for i, name in enumerate(motion.joints)}
        if missing := sorted(used - set(index)):
            raise UserError(f"{motion.name}: no '{missing[0]}', which {self.where} names")
        joints = world[:, [index[names[0]] for names in self.sources]]
        for joint, names in enumerate(self.sources):
            if len(names) > 1:
                joints[:, joint] = world[:, [index[name] for name in names]].mean(axis=1)
        return joints

    def text(self, note: str, skeleton: str = "") -> str:
        """The map file, one row a line so that it can be corrected by hand; open rows are null."""

        def row(index: int, names: tuple[str, ...]) -> str:
            source = names[0] if len(names) == 1 else names or None
            return json.dumps([index, self.target.joints[index], source], ensure_ascii=False)

        rows = ",\n  ".join(row(index, names) for index, names in enumerate(self.sources))
        fields = {
            "note": note,
            "skeleton": skeleton,
            "ends": dict(self.ends),
            "unmapped": list(self.unmapped),
        }
        lines = [
            f"{json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}"
            for key, value in fields.items()
            if value
        ]
        return "{" + ",\n ".join([*lines, f'"{self.target.name}": [\n  {rows}]']) + "}\n"
