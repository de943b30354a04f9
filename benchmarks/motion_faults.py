"""Plants faults in real recordings, before they are resampled, and counts what the judge of motion finds.

    python benchmarks/motion_faults.py SHARED/data --record benchmarks/records/motion_faults.json
    python benchmarks/motion_faults.py SHARED/data --half tune     # the clips that bounds were chosen on
    python benchmarks/motion_faults.py SHARED/data --copies 70     # near duplicates of so many of each set

Each fault is put into the channels of clean BVH and AMC files: 200 files in which the judge finds nothing,
of Bandai-Namco, CMU and HDM05. A fault counts where it moves a joint by `EFFECT` at least, and as found when
its clip is named for one of its kinds. False alarms are those in files as they are, but for recordings
that were looked at and are at fault (`FAULTY`).
"""

from __future__ import annotations

import argparse
import json
import tarfile
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.files import sha256_of_json
from motionloom.datasets.check.duplicates import likeness, near, signature
from motionloom.datasets.convert.bvh.config import BvhClip, BvhConfig
from motionloom.datasets.convert.bvh.convert import Bvh
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.motion.bvh.joint_map import JointMap
from motionloom.datasets.motion.bvh.motion import BvhMotion, channel_columns
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.judge import STEPS, _falls, _swings, judge, on_floor
from motionloom.datasets.motion.plausibility import measure

SETS = {
    "Bandai-Namco": ("bandai", "*.tar.xz"),
    "CMU": ("real/cmu", "*.tar.xz"),
    "HDM05": ("real/hdm05", "*.xz"),
}
Planted = Callable[[BvhMotion, JointMap, np.random.Generator], BvhMotion]


def columns_of(motion: BvhMotion, joint_map: JointMap, names: tuple[str, ...]) -> list[int]:
    """Columns of the rotations of those of the file's joints that stand for ours."""
    turns = channel_columns(motion.channels)[1]
    target = joint_map.target.joints
    wanted = {one for name in names for one in joint_map.sources[target.index(name)]}
    return [
        column for joint, name in enumerate(motion.joints) if name in wanted for column in turns[joint][1]
    ]


def root_columns(motion: BvhMotion) -> list[int]:
    """Columns of the positions, x, y and z, of the first joint that moves."""
    places: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for joint, axis, column in channel_columns(motion.channels)[0]:
        places[joint].append((axis, column))
    moving = (one for one in places.values() if any(np.ptp(motion.values[:, column]) for _, column in one))
    return [column for _, column in sorted(next(moving, places[0]))]


def metre(motion: BvhMotion, joint_map: JointMap) -> float:
    """A metre in lengths of the file, of a figure of 1.65 m."""
    return measure(joint_map.places(motion), motion.fps).height / 1.65


def with_values(motion: BvhMotion, values: NDArray[Any]) -> BvhMotion:
    return replace(motion, values=values)


def stuck(*names: str) -> Planted:
    def go(motion: BvhMotion, joint_map: JointMap, rng: np.random.Generator) -> BvhMotion:
        values = motion.values.copy()
        columns = columns_of(motion, joint_map, names)
        values[:, columns] = values[len(values) // 2, columns]
        return with_values(motion, values)

    return go


def rooted(motion: BvhMotion, joint_map: JointMap, rng: np.random.Generator) -> BvhMotion:
    values = motion.values.copy()
    columns = root_columns(motion)
    values[:, columns] = values[0, columns]
    return with_values(motion, values)


def longer(factor: float) -> Planted:
    def go(motion: BvhMotion, joint_map: JointMap, rng: np.random.Generator) -> BvhMotion:
        limb = ("left_knee", "left_ankle", "right_elbow", "right_wrist")[rng.integers(4)]
        (name, *_) = joint_map.sources[joint_map.target.joints.index(limb)]
        offsets = motion.offsets.copy()
        values = motion.values.copy()
        joint = motion.joints.index(name)
        offsets[joint] *= factor
        values[:, [column for one, _, column in channel_columns(motion.channels)[0] if one == joint]] *= (
            factor
        )
        return replace(motion, offsets=offsets, values=values)

    return go


def shifted(frames: int | None, metres: float) -> Planted:
    def go(motion: BvhMotion, joint_map: JointMap, rng: np.random.Generator) -> BvhMotion:
        values = motion.values.copy()
        at = int(rng.integers(len(motion.values) // 4, len(motion.values) // 2))
        end = len(values) if frames is None else at + frames
        values[at:end, root_columns(motion)[0]] += metres * metre(motion, joint_map)
        return with_values(motion, values)

    return go


def spike(motion: BvhMotion, joint_map: JointMap, rng: np.random.Generator) -> BvhMotion:
    names = ("left_hip", "right_knee", "left_shoulder", "right_elbow")
    values = motion.values.copy()
    columns = columns_of(motion, joint_map, (names[rng.integers(4)],))
    values[int(rng.integers(len(values) // 4, len(values) // 2)), columns[:2]] += 60
    return with_values(motion, values)


def drift(motion: BvhMotion, joint_map: JointMap, rng: np.random.Generator) -> BvhMotion:
    values = motion.values.copy()
    columns = root_columns(motion)
    values[:, columns[0]] += 0.7 * metre(motion, joint_map) * np.arange(len(values)) / motion.fps
    return with_values(motion, values)


def repeated(motion: BvhMotion, joint_map: JointMap, rng: np.random.Generator) -> BvhMotion:
    source = np.arange(motion.frames)
    source[3::4] -= 1
    return with_values(motion, motion.values[source])


def frozen(motion: BvhMotion, joint_map: JointMap, rng: np.random.Generator) -> BvhMotion:
    values = motion.values.copy()
    at = motion.frames // 4
    count = int(0.7 * motion.fps) + 1
    values[at : at + count] = values[at]
    return with_values(motion, values)


def faster(factor: float) -> Planted:
    return lambda motion, joint_map, rng: replace(motion, fps=motion.fps * factor)


def as_is(motion: BvhMotion, joint_map: JointMap, rng: np.random.Generator) -> BvhMotion:
    return motion


LEGS = tuple(f"{side}_{name}" for side in ("left", "right") for name in ("hip", "knee", "ankle"))
FAULTS: dict[str, tuple[Planted, set[str]]] = {
    "knee stuck": (stuck("left_knee"), {"stuck"}),
    "arm stuck": (stuck("right_shoulder", "right_elbow"), {"stuck"}),
    "both legs stuck": (stuck(*LEGS), {"stuck"}),
    "root stuck": (rooted, {"stuck", "slides"}),
    "limb x 1.3": (longer(1.3), {"uneven limbs"}),
    "limb x 1.6": (longer(1.6), {"uneven limbs"}),
    "jump of 20 cm": (shifted(None, 0.2), {"jumps"}),
    "spike of 20 cm, one frame": (shifted(1, 0.2), {"jumps"}),
    "spike of a joint, one frame": (spike, {"flips", "jumps"}),
    "drift of 0.7 m/s": (drift, {"slides"}),
    "every 4th frame repeats": (repeated, {"repeated frames"}),
    "frozen 0.7 s": (frozen, {"frozen"}),
    "5 times too slow": (faster(0.2), {"frame rate"}),
    "2 times too slow": (faster(0.5), {"frame rate"}),
    "2 times too fast": (faster(2.0), {"frame rate", "jumps"}),
    "another axis up": (as_is, {"stands along the ground", "no person"}),
}  # fmt: skip
"""What is planted, and the kinds that name it."""
EFFECT = 0.01
"""Metres that a planted fault moves some joint at least; where it moves none, it was not planted."""
FAULTY = {
    "amc/01_06": "shank turns by 97 and, five frames later, 99 degrees in a 120th of a second; 2 elsewhere",
    "amc/01_13": "half of the joints leap 3 cm in one frame, 0.4 cm in those beside it",
    "amc/01_14": "pelvis falls 5.2 cm in one frame, 0.5 cm in the one before, up again three frames later",
    "amc/03_02": "stands still, then leaps 11 cm in one frame; wrist turns by 92 in one, 0.2 elsewhere",
    "bvh_mb/05_06": "foot turns by 72 degrees in one frame, 1 to 8 in those beside it",
    "bvh_mb/05_08": "foot turns by 130 degrees in one frame, 4 to 10 in those beside it",
    "bvh_mb/05_17": "foot turns by 129 and, three frames later, 125 degrees in one frame",
    "bvh_mb/05_20": "foot turns by 112 and, three frames later, 144 degrees in one frame, 1 to 4 beside them",
}
"""Recordings of the half that is reported whose alarms are true, by what the frames show."""
TIMES = {name for name in FAULTS if "too" in name}
"""Faults that only steps and falls show."""


def shows_time(joints: NDArray[np.float64], fps: float) -> bool:
    """Whether somebody takes as many steps as the judge wants, or jumps."""
    height = measure(joints, fps).height
    body = on_floor(joints)[:, :22]
    return len(_swings(body, fps, height)) >= STEPS or any(_falls(body, fps))


def clips_of(place: Path, pattern: str, folder: Path) -> tuple[Bvh, list[BvhClip]]:
    for path in sorted(place.glob(pattern)):
        with tarfile.open(path) as archive:
            archive.extractall(folder, filter="data")
    given = {"source": folder, "licence": "x", "uncaptioned": "keep"}
    conversion = prepare(BvhConfig.parse(given, "motion_faults"))
    clips = sorted((clip for _, clip in conversion.plan.items), key=lambda clip: sha256_of_json(clip.id))
    return conversion.converter, clips  # type: ignore[return-value]


def joints_with(converter: Bvh, clip: BvhClip, motion: BvhMotion, fault: str) -> NDArray[np.float64]:
    """The joints [T, N, 3] of a clip's motion with a planted fault."""
    rng = np.random.default_rng(int(sha256_of_json([clip.id, fault])[:8], 16))
    motion = FAULTS[fault][0](motion, converter.maps[clip.found.skeleton], rng)
    joints, _ = converter.world(clip, motion)
    return joints[..., [0, 2, 1]] * [1.0, 1.0, -1.0] if fault == "another axis up" else joints


def kinds_of(joints: NDArray[np.float64], fps: float) -> set[str]:
    """Kinds of the faults that the judge finds."""
    return {one.kind for one in judge(on_floor(joints), fps)}


def sliced(part: slice) -> Planted:
    return lambda motion, joint_map, rng: with_values(motion, motion.values[part])


def noisy(motion: BvhMotion, joint_map: JointMap, rng: np.random.Generator) -> BvhMotion:
    values = motion.values.copy()
    columns = [column for _, turns in channel_columns(motion.channels)[1] for column in turns]
    values[:, columns] += rng.normal(0, 0.05, (len(values), len(columns)))
    return with_values(motion, values)


COPIES: dict[str, Planted] = {
    "a frame off the start": sliced(slice(1, None)), "3 frames off the start": sliced(slice(3, None)),
    "15 frames off the start": sliced(slice(15, None)), "2 % slower": faster(1 / 1.02),
    "noise of 0.05 degrees": noisy,
}  # fmt: skip
"""Copies of a recording that show the same motion, by what was done to it."""


def count_copies(data: Path, count: int, folder: Path) -> None:
    """Print how many copies of the first `count` recordings of each set are found, among all of them."""
    joints: list[NDArray[Any]] = []
    copies: dict[str, dict[int, NDArray[Any]]] = {name: {} for name in COPIES}
    for name, (place, pattern) in SETS.items():
        converter, clips = clips_of(data / place, pattern, folder / name)
        for clip in clips[:count]:
            made: dict[str, NDArray[Any]] = {}
            motion = clip.read()
            rng = np.random.default_rng(0)
            for change, plant in {"": as_is, **COPIES}.items():
                changed = plant(motion, converter.maps[clip.found.skeleton], rng)
                clip_of_it = replace(clip, fps=changed.fps, frames=changed.frames)
                seen = converter.world(clip, changed)[0]
                made[change] = joints_of(converter.encode(clip_of_it, seen), converter.layout)
            joints.append(made.pop(""))
            for change, copy in made.items():
                copies[change][len(joints) - 1] = copy
    fps = converter.layout.fps
    signed = [signature(one, fps) for one in joints]
    alike = {(a, b) for a, b, at in near(signed) if likeness(joints[a], joints[b], fps, at).how}
    print(f"{len(alike)} pairs of {len(joints)} recordings are taken for one", flush=True)
    for change, those in copies.items():
        owners = list(those)
        pairs = near([*signed, *(signature(copy, fps) for copy in those.values())])
        found = {
            a for a, b, at in pairs
            if b >= len(joints) and owners[b - len(joints)] == a
            and likeness(joints[a], those[a], fps, at).how
        }  # fmt: skip
        print(f"{change:30} {len(found)} of {len(those)}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--half", choices=("tune", "report"), default="report")
    parser.add_argument(
        "--clips", type=int, default=200, help="clips to plant in, and alarms: five times as many"
    )
    parser.add_argument("--copies", type=int, help="count near duplicates instead, of so many clips of a set")
    parser.add_argument("--record", type=Path)
    options = parser.parse_args()
    if options.copies:
        with tempfile.TemporaryDirectory() as folder:
            count_copies(options.data, options.copies, Path(folder))
        return
    alarms: dict[str, dict[str, Any]] = {}
    clean: dict[str, list[tuple[Bvh, BvhClip]]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        for name, (place, pattern) in SETS.items():
            converter, clips = clips_of(options.data / place, pattern, Path(folder) / name)
            half = [clip for at, clip in enumerate(clips) if at % 2 == (options.half == "report")]
            half = half[: 5 * options.clips]
            told: Counter[str] = Counter()
            named = []
            for clip in half:
                found = kinds_of(converter.world(clip, clip.read())[0], clip.fps)
                told.update(found)
                if found:
                    named.append(f"{clip.id}: {', '.join(sorted(found))}")
                else:
                    clean[name].append((converter, clip))
            false = [line for line in named if line.split(":")[0] not in FAULTY]
            alarms[name] = {"clips": len(half), "alarms": len(named), "false": len(false),
                            "kinds": dict(told), "named": named}  # fmt: skip
            print(name, {**alarms[name], "named": named[:12]}, flush=True)
        # As many of each set as there are, so that the largest does not speak for all.
        chosen = [pair for row in zip_longest_of(list(clean.values())) for pair in row][: options.clips]
        rows = {fault: {"clips": 0, "found": 0} for fault in FAULTS}
        for converter, clip in chosen:
            motion = clip.read()
            clean_joints = converter.world(clip, motion)[0]
            shows = shows_time(clean_joints, clip.fps)
            for fault, (plant, kinds) in FAULTS.items():
                made = joints_with(converter, clip, motion, fault)
                moved = len(made) != len(clean_joints) or np.abs(made - clean_joints).max() > EFFECT
                if shows if fault in TIMES else moved:
                    fps = plant(motion, converter.maps[clip.found.skeleton], np.random.default_rng(0)).fps
                    rows[fault]["clips"] += 1
                    rows[fault]["found"] += bool(kinds & kinds_of(made, fps))
        for fault, row in rows.items():
            print(f"{fault:30} {row['found']} of {row['clips']}", flush=True)
    if options.record is not None:
        record = {"half": options.half, "false alarms": alarms, "planted": rows}
        options.record.write_text(json.dumps(record, indent=1) + "\n", "utf-8")


def zip_longest_of(lists: list[list[Any]]) -> list[list[Any]]:
    """Rows of one of each list, as long as any has one."""
    longest = max(map(len, lists), default=0)
    return [[one[at] for one in lists if at < len(one)] for at in range(longest)]


if __name__ == "__main__":
    main()
