"""BVH conversion, planning: options, the joint map of each skeleton, and what becomes of every file.

Clips have one skeleton when names and parents of their joints are the same; bone lengths may differ. A
skeleton is guessed once, from the first clip of the first plan that has it, so that neither the number of
workers nor files that come later change anything.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import ClassVar, Literal

from pydantic import Field

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_text
from motionloom.datasets.base.records import Caption, Split
from motionloom.datasets.convert.bvh.joint_guess import guess_joint_map, summary
from motionloom.datasets.convert.bvh.read import FoundFile, list_files, read_file, read_motion, scan_files
from motionloom.datasets.convert.bvh.settle import added_frames, settled
from motionloom.datasets.convert.captions.humanml_index import (
    ORIGINALS,
    HumanmlConfig,
    find_originals,
    index_clips,
    settle_index,
)
from motionloom.datasets.convert.captions.options import settle_captions
from motionloom.datasets.convert.common.converter import PlanSettings
from motionloom.datasets.convert.common.facts import Fact, Facts
from motionloom.datasets.convert.common.features import frames_after
from motionloom.datasets.convert.common.files import check_id
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.tables import BadRows, captions_within
from motionloom.datasets.motion.bvh.joint_map import JointMap, UnfinishedMapError, Unit, Up, metres
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


def choose_maps(
    config: BvhConfig, own_maps: Sequence[JointMap], plan: ConversionPlan[BvhClip], folder: Path | None
) -> JointMaps:
    """A map for every skeleton of the planned clips: the user's, else a certain guess.

    Clips of other skeletons leave the plan. Guesses are written into `folder`, where there is one, to be
    completed. `UserError` when no skeleton has a map, and when one of `own_maps` fits none.
    """
    target = config.mapped_skeleton()
    maps: dict[str, JointMap] = {}
    doubts: dict[str, str] = {}
    misfits: dict[str, str] = {}
    skeletons = {clip.found.skeleton: clip.found for _, clip in reversed(plan.items) if clip.found.skeleton}
    # The user's own maps come first: what a person wrote down is never overruled by a guess.
    for key, first in skeletons.items():
        for one in own_maps:
            if one.skeleton in ("", key) and key not in maps:
                try:
                    one.require_fit(first.joints, first.path)
                    maps[key] = one
                except UserError as error:
                    misfits.setdefault(one.where, str(error))
    # Only skeletons that need a guess or a measured unit are read here.
    settles = skeletons.keys() if "auto" in (config.unit, config.up) else set[str]()
    first_clips = _first_clips(plan, settles | (skeletons.keys() - maps.keys()))
    for key, motions in first_clips.items():
        if key in maps:
            continue
        label = motions[0].name
        try:
            guess = guess_joint_map(motions[0], target)
            kept = _kept(guess, key, skeletons[key].joints, folder)
        except ArithmeticError as error:  # bones of no length
            doubts[key] = f"{label}: its figure cannot be measured ({error}); give it a joint map"
            continue
        if kept is None:
            cure = _cure(key, target, folder)
            doubts[key] = f"the joint map of {label} is not certain: no joint for {guess.doubts()}; {cure}"
            continue
        maps[key] = kept
        same = kept.sources == guess.sources
        plan.notes.append(
            f"joint map {guess.where}; {summary(guess)}" if same else f"joint map read from {kept.where}"
        )
    # A map that fits no file is a mistake, unless it lies in a folder with the maps of other sources.
    used = {one.where for one in maps.values()}
    for one in own_maps:
        if one.where not in used and (len(own_maps) == 1 or one.where in misfits):
            raise UserError(misfits.get(one.where, f"{one.where}: no file has its skeleton '{one.skeleton}'"))
    # An uncertain skeleton costs its clips, not the conversion, as long as any other clip is left.
    left = [clip for _, clip in plan.items if clip.found.skeleton in doubts]
    if left and len(left) == len(plan.items):
        doubt, place = next(iter(doubts.values())), MAPS_FOLDER if folder is None else folder / MAPS_FOLDER
        raise UserError(f"{config.source}: {doubt.replace(MAPS_FOLDER, str(place))}")
    plan.items = [item for item in plan.items if item[1].found.skeleton not in doubts]
    plan.notes += doubts.values()
    for key in [key for key in first_clips if key in maps and key in settles]:  # in the plan's order
        with suppress(UserError):  # an End Site that the map names and the files lack: each file says so
            maps[key] = _settle(config, maps[key], first_clips[key], plan)
    for clip in left:
        plan.reject(clip.label(), f"no certain joint map for its skeleton ({doubts[clip.found.skeleton]})")
    return maps


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
        named = f"{metres(unit):.4g} m ({unit if isinstance(unit, str) else 'no known unit fits'})"
        tall = f"the figures are then {height:.2f} m tall"
        plan.notes.append(f"unit by body size, from {name}: {named}; {tall}")
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
    where, certain = _place(key, guess.target), not guess.open_rows
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


class BvhConfig(HumanmlConfig):
    """Options of the BVH converter."""

    layouts = ("body133", "wholebody313", "wholebody363", "h3d263", "tomato623")
    everyday: ClassVar[tuple[str, ...]] = ("captions", "licence", "humanml_index", "humanml_texts")

    source: Path
    """A folder of .bvh or .amc files, or one such file."""
    joint_map: Path | Literal["auto"] = "auto"
    """A JSON file that says which joints of the files stand for ours, or a folder of such files, each for its
    own skeleton (docs/sources.md). Where none fits, and with `auto`, the map is guessed from the names."""
    name: str = "bvh"
    licence: str | None = None
    """Licence of the clips, kept in every sample; needed for a conversion, not for its plan. HumanML3D's
    originals have their own; it then says which of them are converted."""
    layout: str = "body133"
    """Feature layout of the shards: body133, h3d263, or one with hands and a face."""
    fps: float = Field(default=20.0, gt=0, le=240)
    source_fps: float | None = Field(default=None, ge=1, le=10_000)
    """True frame rate of the files, for collections that state a wrong one."""
    unit: Unit | Literal["auto"] = "auto"
    """Length unit of the files: by the size of the bodies (`auto`), a name, or metres (`0.0564`)."""
    up: Up | Literal["auto"] = "auto"
    """Upward axis of the files; `auto`: where the heads are."""
    retarget: bool = False
    """Give every clip the bone lengths of the layout's skeleton."""
    fingers: Literal["recorded", "resting", "missing"] = "recorded"
    """For layouts with hands: the files have them (`recorded`, which needs a joint map with fingers); they
    have none, and each clip gets hands at rest, which count as motion (`resting`) or do not (`missing`).
    """

    def files(self) -> tuple[Path, list[str]]:
        """A folder, and the motion files in it by name."""
        return list_files(self.source)

    def about(self, path: str) -> Facts:
        """Facts of a file in the set's metadata; none for plain folders."""
        return {}

    @property
    def bad_rows(self) -> BadRows:
        """What is wrong with rows of the set's tables, by the names of their files, or by their places."""
        return {}

    def unfit(self, path: str) -> str:
        """Return the reason that the set's lists leave a file out; empty when they do not."""
        return ""

    def cut(self, label: str) -> slice:
        """The frames of a file that are its clip."""
        return slice(None)

    def mapped_skeleton(self) -> Skeleton:
        """The skeleton that the joint map reads: without fingers where the files have none."""
        own = self.motion_layout().skeleton
        return own if self.fingers == "recorded" else Skeleton.named("smpl22")


@dataclass(frozen=True)
class BvhClip:
    """A clip of the plan."""

    folder: Path
    found: FoundFile
    id: str
    split: Split
    texts: tuple[Caption, ...]
    frames: int
    """Frames of the file that are used."""
    fps: float
    about: Facts
    licence: str | None = None
    span: tuple[int, int] | None = None
    """Frames [first, last) of the recording, an added pose in front of it apart; None: all."""
    mirror_of: str | None = None

    @property
    def subset(self) -> str:
        """The folder at the top of the source that it lies in; empty for none."""
        folders = PurePosixPath(self.found.path).parts[:-1]
        return folders[0] if folders else ""

    @property
    def seconds(self) -> float:
        return self.frames / self.fps

    @property
    def facts(self) -> dict[str, Fact]:
        return {"subset": self.subset, "seconds": self.seconds, "fps": self.fps, **self.about}

    def label(self) -> str:
        return self.found.path if self.span is None else f"{self.found.path} ({self.id})"

    def read(self) -> BvhMotion:
        """Return the motion of its file."""
        path = self.found.path
        return read_motion(read_file(self.folder / path, path), path)


def plan_bvh(
    config: BvhConfig, own_maps: Sequence[JointMap], settings: PlanSettings, stated: str
) -> tuple[ConversionPlan[BvhClip], JointMaps]:
    """Find every clip and decide what becomes of it, without converting anything; and the joint maps."""
    folder, names = config.files()
    found = scan_files(folder, names, workers=settings.workers, progress=settings.progress)
    if config.humanml_index is None:
        draft = _decide(config, folder, found, stated)
    else:
        draft = ConversionPlan[BvhClip](config, stated=stated)
        _decide_by_index(config, config.humanml_index, folder, found, draft)
    maps = choose_maps(config, own_maps, draft, settings.maps)
    draft.limit(lambda clip: clip.id)
    if miscounted := [file.path for file in found if file.miscounted]:
        draft.notes.append(
            f"'Frames:' is a row off in {len(miscounted)} of the files (the first: {miscounted[0]}); "
            "all their rows are read"
        )
    layout = config.motion_layout()
    draft.finish(
        found=len(names),
        frames=lambda clip: frames_after(clip.frames, clip.fps, layout),
        licence=lambda clip: clip.licence or "not stated yet",
    )
    return draft, maps


def _decide(config: BvhConfig, folder: Path, found: list[FoundFile], stated: str) -> ConversionPlan[BvhClip]:
    listing = config.listing([file.path for file in found])
    draft = ConversionPlan[BvhClip](config, notes=listing.notes, stated=stated)
    names = {PurePosixPath(file.path).stem for file in found}
    # A file that is here is left out for its row.
    draft.fail_rows({name: why for name, why in config.bad_rows.items() if name not in names})
    contents: dict[str, str] = {}
    # Captioned files first, so that a stray copy never takes the place of the clip that has captions.
    for clip in sorted(found, key=lambda file: file.path not in listing.rows):
        clip_id = listing.id_of(clip.path)
        try:
            check_id(clip_id, clip.path)
            if clip.problem:
                raise UserError(clip.problem)
        except UserError as error:
            draft.fail(clip.path, error)
            continue
        frames = len(range(clip.frames)[config.cut(clip.path)])
        fps = config.source_fps or clip.fps
        same = contents.setdefault(clip.sha256, clip.path)
        reason = (
            (f"same bytes as {same}" if same != clip.path else "")
            or config.unfit(clip.path)
            or listing.problem(clip.path)
            or config.length_problem(frames / fps)
        )
        notes = [] if reason else draft.notes
        texts = captions_within(listing.texts_of(clip.path), frames / fps, clip_id, notes)
        split, about = listing.split_of(clip.path), config.about(clip.path)
        planned = BvhClip(folder, clip, clip_id, split, texts, frames, fps, about, config.licence)
        keep = config.uncaptioned == "keep"
        draft.take(planned, reason, captioned=bool(texts), wanted=config.has_captions, keep=keep)
    settle_captions(config, draft, listing)
    return draft


def _decide_by_index(
    config: BvhConfig, index: Path, folder: Path, scan: list[FoundFile], draft: ConversionPlan[BvhClip]
) -> None:
    """Plan the clips that HumanML3D's index cuts from the free originals."""
    files = {file.path: file for file in scan}
    for file in files.values():
        if file.problem:
            draft.fail(file.path, UserError(file.problem))
    found = find_originals(config, index, files, draft)
    listed, notes = config.index_splits()
    draft.notes += notes
    apart: list[str] = []
    for one in index_clips(config, found, listed):
        file, row = files[one.file or ""], one.row
        if file.problem:
            continue
        fps = config.source_fps or row.true_fps(file.fps)
        first, last, wrong = row.span(file.frames, fps)
        texts, broken = config.index_texts(one.id, (last - first) / fps, draft.notes)
        clip = BvhClip(
            folder, file, one.id, one.split, texts, last - first, fps, {"subset": row.subset},
            ORIGINALS[row.subset], (first, last), one.mirror_of,
        )  # fmt: skip
        apart += [f"{clip.label()}: {wrong}"] if wrong else []
        unlisted = listed is not None and one.id not in listed
        reason = wrong or broken or ("in no split file" if unlisted else config.length_problem(clip.seconds))
        keep, wanted = config.uncaptioned == "keep", config.has_captions
        draft.take(clip, reason, captioned=bool(texts), wanted=wanted, keep=keep)
    settle_index(config, draft, apart)
