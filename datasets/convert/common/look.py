"""A look at a source before it is converted: a few clips of every subset, in memory, measured as figures.

A plan made of names and headers is the same for a wrong joint map, a wrong length unit and a wrong upward
axis, and so is everything after it but the people. So a few clips are read the way the conversion would read
them, and measured as the check of a data set does (`motion/plausibility.py`). Where that is no person
standing on a floor, the same clips are tried along the other axes and in the other units, and the option that
makes people of them is suggested.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape
from rich.table import Table

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of_json
from motionloom.datasets.base.printable import printable
from motionloom.datasets.base.records import Dropped, Fault
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.motion.bvh.joint_map import METRES, NamedUnit, metres
from motionloom.datasets.motion.judge import judge, on_floor
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.plausibility import MOST, PERSON_METRES, PlausibilityStats, measure
from motionloom.datasets.shards.left_out import drop, grouped

CHILD_METRES = 0.7
"""Height of a figure, at least, where its unit is stated: a child of one year."""
ADULT_METRES = 1.7
"""Height of an ordinary adult: of two units that make a person of a figure, the nearer one is meant."""


@dataclass(frozen=True)
class Suggestion:
    """A change that makes people of what was seen."""

    option: Literal["up", "unit", "joint_map", "source"]
    value: str
    """An axis, a unit, or lines of the joint map; a sentence where no option helps."""
    why: str

    def __str__(self) -> str:
        if self.option in ("up", "unit"):
            return f"--set {self.option}={self.value} ({self.why})"
        return f"{'in the joint map: ' if self.option == 'joint_map' else ''}{self.value} ({self.why})"


@dataclass(frozen=True)
class SourceJoints:
    """A clip as a converter reads it, before anything is made canonical."""

    joints: NDArray[np.floating]
    """World positions [T, N, 3] in metres, Y up, after the options for unit and axis."""
    fps: float
    mapped: bool = False
    """Whether a joint map was used."""
    up: str = "y"
    """The upward axis of the file."""
    is_sized: bool = False
    """Whether somebody has stated the unit, so that the figure's size is believed."""

    def faults(self, fps: float) -> tuple[Fault, ...]:
        """What the judge of motion finds; frames are counted at `fps`."""
        small = CHILD_METRES if self.is_sized else PERSON_METRES[0]
        found = judge(on_floor(self.joints), self.fps, small=small)
        return tuple(one.model_copy(update={"frame": int(one.frame * fps / self.fps)}) for one in found)


def stats_of(clips: Iterable[SourceJoints]) -> PlausibilityStats:
    """The clips measured."""
    stats = PlausibilityStats()
    for clip in clips:
        stats.add(measure(clip.joints, clip.fps))
    return stats


def _suggest(clips: list[SourceJoints], config: ConvertConfig) -> list[Suggestion]:
    """Changes that together make people of the clips: axis, unit, sides."""
    out: list[Suggestion] = []
    seen = stats_of(clips)
    if seen.upright <= MOST:
        axis = head_axis(clips)
        why = f"the head is above the pelvis along the {axis} axis of the files"
        turn = Suggestion("source", "turn the files so that y or z points up", why)
        is_option = hasattr(config, "up") and axis in ("+y", "+z")
        out.append(Suggestion("up", axis[1], why) if is_option else turn)
    # A height is made of lengths, so it is right along any axis; sides show in upright figures alone.
    if not PERSON_METRES[0] <= seen.height <= PERSON_METRES[1]:
        out.append(_suggest_unit(seen.height, config))
    if not out and any(oddity.kind == "left and right" and oddity.is_error for oddity in seen.oddities()):
        why = "the feet point backwards"
        rows = Suggestion("joint_map", "exchange the left and the right rows", why)
        mapped = any(clip.mapped for clip in clips)
        out.append(rows if mapped else Suggestion("source", "exchange left and right in the source", why))
    return out


def named_unit(height: float) -> NamedUnit | None:
    """The known unit in which a figure of this height in lengths of the file is a person, if any is."""
    fits = [unit for unit, size in METRES.items() if PERSON_METRES[0] <= height * size <= PERSON_METRES[1]]
    return min(fits, key=lambda unit: abs(np.log(height * METRES[unit] / ADULT_METRES)), default=None)


def _suggest_unit(height: float, config: ConvertConfig) -> Suggestion:
    """The unit that makes people of figures that are `height` metres tall in the unit that was taken."""
    own: Any = getattr(config, "unit", None)
    in_files = height / (1.0 if own in (None, "auto") else metres(own))
    unit = named_unit(in_files)
    if unit is None:
        value = f"{ADULT_METRES / max(in_files, 1e-9):.4g}"
        why = f"the figures are {height:.3g} m tall, and no unit makes 1.2 to 2.2 m of it"
    else:
        value = unit
        why = f"then the figures are {in_files * METRES[unit]:.2f} m tall"
    if own is None:
        return Suggestion("source", f"scale the files to metres, from {value}", why)
    return Suggestion("unit", value, why)


def head_axis(clips: Iterable[SourceJoints]) -> str:
    """The axis of the files along which the head lies from the pelvis in most clips."""
    votes: Counter[str] = Counter()
    for clip in clips:
        x, y, z = measure(clip.joints, clip.fps).up
        along = np.array((x, -z, y) if clip.up == "z" else (x, y, z))
        axis = int(np.abs(along).argmax())
        votes[("+" if along[axis] > 0 else "-") + "xyz"[axis]] += 1
    return votes.most_common(1)[0][0]


MOST_CLIPS = 96
"""Clips that are looked at in all; of sources with more subsets, fewer a subset and then fewer subsets."""

SAMPLE = 200
"""Clips that a plan converts in memory at most, but for what gives each stratum of a source its share: of a
fault in 2 of 100 clips it shows one in 98 of 100 plans [ours]."""

_SPARE = 8
"""Clips of a subset that may be damaged before the look gives it up [ours]."""

_FRAMES_A_SECOND = 10.0

T = TypeVar("T")


@dataclass(frozen=True)
class SubsetLook:
    """The measured clips of one subset."""

    name: str
    clips: int
    """Clips that were read."""
    height: float | None
    """Metres, the median figure; None when no clip could be read."""
    upright: int
    """Clips whose head is above the pelvis."""
    head: str
    """Axis of the files along which the head lies from the pelvis in most clips: `+y`, `-z`."""
    above_floor: float | None
    """Metres from the floor of its clip to the lowest joint of the median frame."""
    fps: tuple[float, ...]
    """Frame rates of the files."""


@dataclass(frozen=True)
class Look:
    """The measured clips of a source, and the verdict."""

    subsets: tuple[SubsetLook, ...]
    problems: tuple[str, ...] = ()
    """Reasons to refuse the conversion: these are no people standing on a floor."""
    warnings: tuple[str, ...] = ()
    """Odd measurements that may be meant."""
    suggestions: tuple[Suggestion, ...] = ()
    all_subsets: int = field(default=0)
    """Subsets of the source, those not looked at too."""

    @property
    def clips(self) -> int:
        return sum(subset.clips for subset in self.subsets)

    def table(self) -> Table:
        of = "" if len(self.subsets) == self.all_subsets else f" ({len(self.subsets)} of {self.all_subsets})"
        table = Table(
            *(f"subset{of}", "clips", "height", "head above pelvis", "lowest joint", "fps"), title="seen"
        )
        for seen in self.subsets:
            head = f"{seen.upright} of {seen.clips}, along {seen.head} of the files"
            table.add_row(
                escape(printable(seen.name)) or ".",
                str(seen.clips),
                "" if seen.height is None else f"{seen.height:.3g} m",
                head if seen.clips else "",
                "" if seen.above_floor is None else f"{seen.above_floor:.2f} m above the floor",
                ", ".join(f"{fps:g}" for fps in seen.fps),
            )
        return table

    def lines(self) -> list[str]:
        return [
            *(f"problem: {text}" for text in self.problems),
            *(f"try: {suggestion}" for suggestion in self.suggestions),
            *(f"warning: {text}" for text in self.warnings),
        ]

    def require_people(self, source: str) -> None:
        if not self.problems:
            return
        if not self.clips:  # nobody was seen, and a conversion would read no more
            raise UserError(f"{source}: {'; '.join(self.problems)}")
        tries = "".join(f"; try {suggestion}" for suggestion in self.suggestions)
        raise UserError(
            f"{source}: no people standing on a floor were seen in {self.clips} clips: "
            f"{'; '.join(self.problems)}{tries}; to convert it as it is: --set look=0"
        )


def look_at(
    items: Sequence[T],
    see: Callable[[T], SourceJoints],
    subset_of: Callable[[T], str],
    config: ConvertConfig,
    *,
    label: Callable[[T], str],
) -> Look:
    """Read and measure `config.look` clips of every subset, chosen by a hash of their names."""
    subsets = set(map(subset_of, items))
    names = sorted(sorted(subsets, key=sha256_of_json)[:MOST_CLIPS])
    each = max(1, min(config.look, MOST_CLIPS // max(1, len(names))))
    clips: dict[str, list[SourceJoints]] = {name: [] for name in names}
    rates: dict[str, set[float]] = defaultdict(set)
    failed: list[Dropped] = []
    of_these = [item for item in items if subset_of(item) in clips]
    for item in sampled(of_these, subset_of, each + _SPARE, label, most=0):
        name = subset_of(item)
        if len(clips[name]) == each:
            continue
        try:
            seen = see(item)
            if not np.isfinite(seen.joints).all():
                raise UserError(f"{label(item)}: NaN or infinity")
        except Exception as error:  # whatever a bad file makes of the libraries below; the conversion says it
            failed.append(drop(label(item), error))
            continue
        # Ten frames a second are enough for medians, and keep hundreds of clips in memory.
        step = max(1, round(seen.fps / _FRAMES_A_SECOND))
        body = np.asarray(seen.joints[::step, :BODY_JOINTS], dtype=np.float64)
        clips[name].append(replace(seen, joints=body, fps=seen.fps / step))
        rates[name].add(seen.fps)
    found = [_subset(name, seen_there, rates[name]) for name, seen_there in clips.items()]
    all_clips = [clip for seen_there in clips.values() for clip in seen_there]
    oddities = stats_of(all_clips).oddities()
    problems = [oddity.text for oddity in oddities if oddity.is_error]
    warnings = [oddity.text for oddity in oddities if not oddity.is_error]
    suggestions = _suggest(all_clips, config) if problems else []
    # One reason for every clip is a wrong option or map; several reasons are damaged files.
    groups = grouped(failed)
    if len(groups) == 1 and not all_clips:
        problems = [f"none could be read: {groups[0]}"]
    return Look(
        subsets=tuple(found),
        problems=tuple(problems),
        warnings=tuple(warnings),
        suggestions=tuple(suggestions),
        all_subsets=len(subsets),
    )


def sampled(
    items: Iterable[T], stratum: Callable[[T], str], each: int, label: Callable[[T], str], most: int = SAMPLE
) -> list[T]:
    """Return `each` items of every stratum and, while these are fewer than `most`, others."""
    seen: Counter[str] = Counter()
    first: list[T] = []
    later: list[T] = []
    # A hash chooses, so that neither the order of files nor the number of workers changes the verdict.
    for item in sorted(items, key=lambda item: sha256_of_json(label(item))):
        name = stratum(item)
        (first if seen[name] < each else later).append(item)
        seen[name] += 1
    return [*first, *later[: max(0, most - len(first))]]


def _subset(name: str, clips: list[SourceJoints], rates: set[float]) -> SubsetLook:
    stats = stats_of(clips)
    return SubsetLook(
        name=name,
        clips=len(clips),
        height=round(stats.height, 4) if clips else None,
        upright=round(stats.upright * len(clips)) if clips else 0,
        head=head_axis(clips) if clips else "",
        above_floor=round(stats.above_floor, 4) if clips else None,
        fps=tuple(sorted(rates)),
    )
