"""A look at a source before it is converted: a few clips of every subset, in memory, measured as figures.

A plan made of names and headers is the same for a wrong joint map, a wrong length unit and a wrong upward
axis, and so is everything after it but the people. So a few clips are read the way the conversion would read
them, and measured (`datasets/motion/standing.py`, as the check of a data set does). Where that is no person
standing on a floor, the same clips are tried with two joints exchanged, along the other axes and in the other
units; what makes people of them is suggested, by the option or the lines of the joint map to change.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape
from rich.table import Table

from motionloom.datasets.base.files import sha256_of_json
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.corrections import (
    Names,
    SeenClip,
    Suggestion,
    crowd_of,
    head_axis,
    suggest,
)
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.swapped_joints import find_swap
from motionloom.datasets.schema import Dropped, UserError
from motionloom.datasets.shards.left_out import grouped

MOST_CLIPS = 96
"""Clips that are looked at in all; of sources with more subsets, fewer a subset and then fewer subsets."""

_FRAMES_A_SECOND = 10.0

T = TypeVar("T")


@dataclass(frozen=True)
class SourceJoints:
    """A clip as a converter reads it, before anything is made canonical."""

    joints: NDArray[Any]
    """World positions [T, N, 3] in metres, Y up, after the options for unit and axis."""
    fps: float
    names: Names = ()
    """What stands for each joint in the file (several: their mean), where a joint map says it."""
    remarks: tuple[str, ...] = ()
    """What a user should know about the file, the same words for the same thing."""


@dataclass(frozen=True)
class SubsetLook:
    """What was seen of one subset."""

    name: str
    clips: int
    """Clips that were read."""
    unreadable: int
    height: float | None
    """Metres, the median figure; None when no clip could be read."""
    upright: int
    """Clips whose head is above the pelvis."""
    head: str
    """Axis of the files along which the head lies from the pelvis in most clips: `+y`, `-z`."""
    above_floor: float | None
    """Metres from the floor of its clip to the lowest joint of the median frame."""
    walking: int
    """Clips in which the figure goes somewhere."""
    backwards: int
    """Of these, those in which it goes backwards."""
    fps: tuple[float, ...]
    """Frame rates of the files."""


@dataclass(frozen=True)
class Look:
    """What was seen of a source."""

    subsets: tuple[SubsetLook, ...]
    problems: tuple[str, ...] = ()
    """Why these are no people standing on a floor; the conversion is refused for them."""
    warnings: tuple[str, ...] = ()
    """What is odd, but may be meant."""
    suggestions: tuple[Suggestion, ...] = ()
    remarks: tuple[str, ...] = ()
    all_subsets: int = field(default=0)
    """Subsets of the source, those not looked at too."""

    @property
    def clips(self) -> int:
        """Clips that were read."""
        return sum(subset.clips for subset in self.subsets)

    def dump(self) -> dict[str, Any]:
        """As plain JSON values."""
        return asdict(self)

    def table(self) -> Table:
        """What was seen, a row a subset, for a terminal."""
        of = "" if len(self.subsets) == self.all_subsets else f" ({len(self.subsets)} of {self.all_subsets})"
        table = Table(
            *(f"subset{of}", "clips", "height", "head above pelvis", "lowest joint", "walking", "fps"),
            title="seen",
        )
        for seen in self.subsets:
            head = f"{seen.upright} of {seen.clips}, along {seen.head} of the files"
            back = f", {seen.backwards} backwards" if seen.backwards else ""
            table.add_row(
                escape(seen.name) or ".",
                str(seen.clips) + (f", {seen.unreadable} unreadable" if seen.unreadable else ""),
                "" if seen.height is None else f"{seen.height:.3g} m",
                head if seen.clips else "",
                "" if seen.above_floor is None else f"{seen.above_floor:.2f} m above the floor",
                f"{seen.walking}{back}",
                ", ".join(f"{fps:g}" for fps in seen.fps),
            )
        return table

    def lines(self) -> list[str]:
        """What follows from it, most serious first; empty lines are never among them."""
        return [
            *(f"problem: {text}" for text in self.problems),
            *(f"try: {suggestion}" for suggestion in self.suggestions),
            *(f"warning: {text}" for text in self.warnings),
            *(f"note: {text}" for text in self.remarks),
        ]

    def require_people(self, source: str) -> None:
        """`UserError` when these are no people standing on a floor."""
        if not self.problems:
            return
        tries = "".join(f"; try {suggestion}" for suggestion in self.suggestions)
        raise UserError(
            f"{source}: no people standing on a floor were seen in {self.clips} clips: "
            f"{'; '.join(self.problems)}{tries}; to convert it as it is: --look 0"
        )


def look_at(
    items: Sequence[T],
    see: Callable[[T], SourceJoints],
    subset_of: Callable[[T], str],
    config: ConvertConfig,
    *,
    label: Callable[[T], str],
    in_order: Callable[[T], bool] | None = None,
) -> Look:
    """Read and measure `config.look` clips of every subset.

    They are chosen by a hash of their names; where `in_order` says so of a clip, its subset gives its first
    ones: in an archive, what comes late costs time.
    """
    chosen, subsets = _choose(items, subset_of, config.look, label, in_order)
    clips: list[SeenClip] = []
    failed: list[tuple[str, Dropped]] = []
    remarks: Counter[str] = Counter()
    names: Names = ()
    for name, item in chosen:
        try:
            seen = see(item)
            if not np.isfinite(seen.joints).all():
                raise UserError(f"{label(item)}: NaN or infinity")
        except Exception as error:  # whatever a bad file makes of the libraries below; the conversion says it
            reason = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
            failed.append((name, Dropped(source=label(item), reason=reason.removeprefix(f"{label(item)}: "))))
            continue
        step = max(1, round(seen.fps / _FRAMES_A_SECOND))
        body = np.asarray(seen.joints[::step, :BODY_JOINTS], dtype=np.float64)
        clips.append(SeenClip(name, body, seen.fps / step, seen.fps))
        remarks.update(seen.remarks)
        names = names or seen.names
    unreadable = Counter(name for name, _ in failed)
    up = str(getattr(config, "up", "y"))
    found = [
        _subset(name, [clip for clip in clips if clip.subset == name], unreadable[name], up)
        for name in dict.fromkeys(name for name, _ in chosen)
    ]
    problems, warnings, suggestions = _judge(clips, config, names, up)
    groups = grouped([drop for _, drop in failed])
    if failed and not clips and len(groups) == 1:
        problems = [f"none could be read: {groups[0]}"]
    else:
        warnings += [f"cannot be read: {group}" for group in groups]
    return Look(
        subsets=tuple(found),
        problems=tuple(problems),
        warnings=tuple(warnings),
        suggestions=tuple(suggestions),
        remarks=tuple(f"{text} ({count} of {len(clips)} clips)" for text, count in remarks.most_common()),
        all_subsets=subsets,
    )


def _choose(
    items: Sequence[T],
    subset_of: Callable[[T], str],
    count: int,
    label: Callable[[T], str],
    in_order: Callable[[T], bool] | None,
) -> tuple[list[tuple[str, T]], int]:
    """(subset, item) of the clips to look at, and how many subsets there are."""
    by_subset: dict[str, list[T]] = defaultdict(list)
    for item in items:
        by_subset[subset_of(item)].append(item)
    names = sorted(by_subset)
    if len(names) > MOST_CLIPS:
        names = sorted(sorted(names, key=sha256_of_json)[:MOST_CLIPS])
    each = max(1, min(count, MOST_CLIPS // max(1, len(names))))
    chosen: list[tuple[str, T]] = []
    for name in names:
        members = by_subset[name]
        if len(members) > each and not (in_order is not None and in_order(members[0])):
            members = sorted(members, key=lambda item: sha256_of_json(label(item)))
        chosen += [(name, item) for item in members[:each]]
    return chosen, len(by_subset)


def _subset(name: str, clips: list[SeenClip], unreadable: int, up: str) -> SubsetLook:
    crowd = crowd_of(clips)
    return SubsetLook(
        name=name,
        clips=len(clips),
        unreadable=unreadable,
        height=round(crowd.height, 4) if clips else None,
        upright=round(crowd.upright * len(clips)) if clips else 0,
        head=head_axis(clips, up) if clips else "",
        above_floor=round(crowd.above_floor, 4) if clips else None,
        walking=crowd.walking,
        backwards=crowd.backwards,
        fps=tuple(sorted({clip.file_fps for clip in clips})),
    )


def _judge(
    clips: list[SeenClip], config: ConvertConfig, names: Names, up: str
) -> tuple[list[str], list[str], list[Suggestion]]:
    """Problems, warnings, and what would make people of the clips."""
    oddities = crowd_of(clips).oddities()
    swap = find_swap([clip.joints for clip in clips])
    problems = [oddity.text for oddity in oddities if oddity.is_error]
    warnings = [oddity.text for oddity in oddities if not oddity.is_error]
    by_subset: dict[str, list[SeenClip]] = defaultdict(list)
    for clip in clips:
        by_subset[clip.subset].append(clip)
    known = {oddity.kind for oddity in oddities if oddity.is_error}
    for name, members in sorted(by_subset.items()):
        if len(by_subset) > 1:
            warnings += [
                f"{name}: {oddity.text}"
                for oddity in crowd_of(members).oddities()
                if oddity.is_error and oddity.kind not in known
            ]
    if swap is not None:
        first, second = swap.names
        problems.insert(0, f"{first} and {second} stand in each other's place")
    return problems, warnings, suggest(clips, swap, config, names, up) if problems else []
