"""The joint map of each skeleton of a BVH conversion: the user's, else a certain guess.

Clips have one skeleton when names and parents of their joints are the same; bone lengths may differ. A
skeleton is guessed once, from the first clip of the first plan that has it, so that neither the number of
workers nor files that come later change anything.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_text
from motionloom.datasets.convert.bvh.config import BvhClip, BvhConfig
from motionloom.datasets.convert.bvh.joint_guess import guess_joint_map, summary
from motionloom.datasets.convert.bvh.read import FoundFile
from motionloom.datasets.convert.bvh.settle import added_frames, settled
from motionloom.datasets.convert.common.look import CHILD_METRES
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.motion.bvh.joint_map import METRES, JointMap, UnfinishedMapError, metres
from motionloom.datasets.motion.bvh.motion import BvhMotion
from motionloom.datasets.motion.skeleton import Skeleton

MAPS_FOLDER = "joint_maps"
"""In the folder of the shards: the maps that were guessed, one for each skeleton."""


JointMaps = Mapping[str, JointMap]
"""The joint maps of a conversion, by `skeleton_key`."""

_MEASURED = 5
"""Clips of a skeleton by which its unit and its upward axis are settled: one may lie on the floor."""


def load_maps(choice: Path | str, target: Skeleton) -> list[JointMap]:
    """The maps of a file, or of the .json files of a folder that hold any for `target`; none for `auto`."""
    if not isinstance(choice, Path):
        return []
    if not choice.is_dir():
        return [JointMap.load(choice, target=target.name)]
    found = []
    for path in sorted(choice.glob("*.json")):
        with suppress(UnfinishedMapError):  # its skeleton is left out, and said
            found.append(JointMap.load(path, target=target.name))
    if not found:
        raise UserError(f"{choice}: no finished joint map (.json) in it")
    return found


@dataclass
class _Choice:
    """Maps as they are chosen, by skeleton, and why some skeletons or maps of the user have none."""

    own: Sequence[JointMap]
    """The user's."""
    maps: dict[str, JointMap] = field(default_factory=dict)
    doubts: dict[str, str] = field(default_factory=dict)
    """Skeletons without a certain map."""
    misfits: dict[str, str] = field(default_factory=dict)
    """Maps of the user that do not fit the skeleton that they are for, by where they are from."""

    def take_own(self, skeletons: Mapping[str, FoundFile]) -> None:
        """The user's maps come first: what a person wrote down is never overruled by a guess."""
        for key, first in skeletons.items():
            for one in self.own:
                if one.skeleton in ("", key) and key not in self.maps:
                    try:
                        one.require_fit(first.joints, first.path)
                        self.maps[key] = one
                    except UserError as error:
                        self.misfits.setdefault(one.where, str(error))

    def guess(self, motion: BvhMotion, key: str, target: Skeleton, folder: Path | None) -> str:
        """Guess the map of a skeleton from its first clip, and return a note on it; empty when in doubt."""
        label = motion.name
        try:
            guess = guess_joint_map(motion, target)
            kept = _kept(guess, key, motion.joints, folder)
        except ArithmeticError as error:  # bones of no length
            self.doubts[key] = f"{label}: its figure cannot be measured ({error}); give it a joint map"
            return ""
        if kept is None:
            cure = _cure(key, target, folder)
            twice = [name for name, count in Counter(motion.joints).items() if count > 1]
            shared = (
                f" ({', '.join(twice[:3])}: a name that several joints have says nothing)" if twice else ""
            )
            doubt = f"no joint for {guess.doubts()}{shared}"
            self.doubts[key] = f"the joint map of {label} is not certain: {doubt}; {cure}"
            return ""
        self.maps[key] = kept
        if kept.sources != guess.sources:
            return f"joint map read from {kept.where}"
        return f"joint map {guess.where}; {summary(guess)}"

    def require_used(self) -> None:
        """A map that fits no file is a mistake, unless it lies in a folder with the maps of other sources."""
        used = {one.where for one in self.maps.values()}
        for one in self.own:
            if one.where not in used and (len(self.own) == 1 or one.where in self.misfits):
                unused = f"{one.where}: no file has its skeleton '{one.skeleton}'"
                raise UserError(self.misfits.get(one.where, unused))


def choose_maps(
    config: BvhConfig, own_maps: Sequence[JointMap], plan: ConversionPlan[BvhClip], folder: Path | None
) -> JointMaps:
    """A map for every skeleton of the planned clips: the user's, else a certain guess.

    Clips of other skeletons leave the plan. Guesses are written into `folder`, where there is one, to be
    completed. `UserError` when no skeleton has a map, and when one of `own_maps` fits none.
    """
    choice = _Choice(own_maps)
    skeletons = {clip.found.skeleton: clip.found for _, clip in reversed(plan.items) if clip.found.skeleton}
    choice.take_own(skeletons)
    # Only skeletons that need a guess or a measured unit are read here.
    settles = skeletons.keys() if "auto" in (config.unit, config.up) else set[str]()
    first_clips = _first_clips(plan, settles | (skeletons.keys() - choice.maps.keys()))
    for key, motions in first_clips.items():
        if key not in choice.maps:
            note = choice.guess(motions[0], key, config.mapped_skeleton(), folder)
            plan.notes += [note] if note else []
    choice.require_used()
    _leave_doubtful(config, choice.doubts, plan, folder)
    for key, motions in first_clips.items():  # in the plan's order
        if key in choice.maps and key in settles:
            with suppress(UserError):  # an End Site that the map names and the files lack: each file says so
                choice.maps[key] = _settle(config, choice.maps[key], motions, plan)
    return choice.maps


def _leave_doubtful(
    config: BvhConfig, doubts: Mapping[str, str], plan: ConversionPlan[BvhClip], folder: Path | None
) -> None:
    """Reject the clips of skeletons without a map; `UserError` if that leaves none."""
    left = [clip for _, clip in plan.items if clip.found.skeleton in doubts]
    if left and len(left) == len(plan.items):
        doubt = next(iter(doubts.values()))
        place = MAPS_FOLDER if folder is None else folder / MAPS_FOLDER
        raise UserError(f"{config.source}: {doubt.replace(MAPS_FOLDER, str(place))}")
    plan.items = [item for item in plan.items if item[1].found.skeleton not in doubts]
    plan.notes += doubts.values()
    for clip in left:
        plan.mark_rejected(clip, f"no certain joint map for its skeleton ({doubts[clip.found.skeleton]})")


def _settle(
    config: BvhConfig, joint_map: JointMap, motions: Sequence[BvhMotion], plan: ConversionPlan[BvhClip]
) -> JointMap:
    """Return the map with the unit and upward axis that some of its clips show, with a note in the plan."""
    stated = replace(
        joint_map,
        unit=joint_map.unit or (None if config.unit == "auto" else config.unit),
        up=joint_map.up or (None if config.up == "auto" else config.up),
    )
    unit, up, height = settled(stated, motions)
    measured = replace(stated, unit=unit, up=up, measured=stated.unit is None)
    name = motions[0].name
    if stated.unit is None:
        tall = f"the figures are then {height:.2f} m tall"
        if isinstance(unit, str):
            plan.notes.append(f"unit by body size, from {name}: {metres(unit):.4g} m ({unit}); {tall}")
        else:
            sizes = {one: height * size / unit for one, size in METRES.items()}
            near = [f"{size:.2f} m in {one}" for one, size in sizes.items() if CHILD_METRES < size < 3]
            plan.notes.append(
                f"unit by body size, from {name}: no known unit fits, so {unit:.4g} m is guessed; "
                f"{tall}, but {' or '.join(near) or 'of no size in any unit'}: is it a child? "
                f"--set unit=NAME states it"
            )
    if up != "y" and stated.up is None:
        plan.notes.append(f"upward axis by where heads are, from {name}: {up}")
    if any(added_frames(measured.apply(motion)) for motion in motions):
        plan.notes.append(f"first frames that are an added T-pose are left out, as in {name}")
    return measured


def _first_clips(plan: ConversionPlan[BvhClip], skeletons: Set[str]) -> dict[str, list[BvhMotion]]:
    """The first readable clips of each of the skeletons."""
    found: defaultdict[str, list[BvhMotion]] = defaultdict(list)
    for _, clip in plan.items:
        key = clip.found.skeleton
        if key in skeletons and len(found.get(key, ())) < _MEASURED:
            with suppress(Exception):  # told when it is converted; the next clip may be whole
                motion = clip.read()
                found[key].append(motion)  # no entry for a skeleton of which no file can be read
    return found


def _kept(guess: JointMap, key: str, joints: Sequence[str], folder: Path | None) -> JointMap | None:
    """Return a skeleton's map that lies in `folder`, as an earlier run guessed it or a hand completed it,
    so that files that come later change nothing for the others. Where there is none, the guess is written
    there, and returned if it is certain.
    """
    where = _place(key, guess.target)
    certain = not guess.open_rows
    if folder is not None:
        path = folder / where
        if not path.exists():
            todo = "" if certain else ". NOT CERTAIN: fill in the rows that say null"
            write_text(path, guess.text(f"{guess.where}: {summary(guess)}{todo}", key))
        with suppress(UnfinishedMapError):
            kept = replace(JointMap.load(path, target=guess.target.name), where=where)
            kept.require_fit(joints, guess.where)
            return kept
    return replace(guess, where=where) if certain else None


def _place(key: str, target: Skeleton) -> str:
    """Name of a guessed map in the folder of the shards."""
    return f"{MAPS_FOLDER}/{target.name}-{key}.json"


def _cure(key: str, target: Skeleton, folder: Path | None) -> str:
    """Return what the user can do about a map that is not certain."""
    if folder is None:
        return "planned with `out=FOLDER` it writes a map to complete"
    # As the manifest has it, where no path of a machine stands: from the folder of the shards on.
    where = _place(key, target)
    return f"complete {where} and give the command again, elsewhere with --set joint_map={MAPS_FOLDER}"
