"""Which joint map a clip goes through: the given one for all, or one guessed for each skeleton of the source.

Clips have one skeleton when names and parents of their joints are the same; bone lengths may differ. A
skeleton is guessed once, from the first clip of the plan that has it, so that the number of workers and the
order of their work change nothing.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator

from motionloom.datasets.base.files import sha256_of_json, write_text
from motionloom.datasets.convert.common.archives import Batch, list_batches
from motionloom.datasets.motion.bvh import BvhMotion, read_bvh
from motionloom.datasets.motion.joint_guess.guess import guess_joint_map
from motionloom.datasets.motion.joint_guess.result import JointGuess
from motionloom.datasets.motion.joint_map import JointMap
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError

MapChoice = Annotated[
    Path | Literal["auto"], BeforeValidator(lambda given: "auto" if str(given) == "auto" else given)
]
"""A map file, or `auto` (from the command line also as a path) for one that is guessed."""

SUFFIX = ".bvh"


@dataclass(frozen=True)
class JointMaps:
    """The joint maps of a conversion."""

    given: JointMap | None
    """The user's, for every clip."""
    guessed: Mapping[str, JointMap]
    """By `skeleton_key`, where none is given."""

    def of(self, motion: BvhMotion) -> JointMap:
        """The map of one clip."""
        if self.given is not None:
            return self.given
        try:
            return self.guessed[skeleton_key(motion.joints, motion.parents)]
        except KeyError:
            raise UserError(
                f"{motion.name}: its skeleton was not there when the source was planned"
            ) from None


def skeleton_key(joints: Sequence[str], parents: Sequence[int]) -> str:
    """What clips with one skeleton share."""
    return sha256_of_json([list(joints), list(parents)])[:16]


def guess_maps(
    clips: Iterable[tuple[Batch, str, str]], target: Skeleton, source: Path, folder: Path | None
) -> dict[str, JointGuess]:
    """A certain guess for every skeleton of the planned clips (batch, label, skeleton's key).

    With `folder` each is written there as a map file. `UserError` when one is not certain, or when another
    map lies there already: it may have been corrected by hand.
    """
    wanted: dict[Batch, dict[str, str]] = {}
    for batch, label, key in clips:
        wanted.setdefault(batch, {})[label] = key
    guesses: dict[str, JointGuess] = {}
    for batch, labels in wanted.items():
        missing = {key for key in labels.values() if key} - set(guesses)
        with suppress(UserError):  # a damaged archive; its clips are reported when they are converted
            for file in batch.read(SUFFIX) if missing else ():
                if labels.get(file.label) not in missing:
                    continue
                with suppress(UserError):  # likewise; the next clip of this skeleton may be whole
                    guess = guess_joint_map(read_bvh(file.data, name=file.label), target)
                    guesses[labels[file.label]] = guess
                    missing.remove(labels[file.label])
                if not missing:
                    break
    written = {key: _written(guess, number, folder) for number, (key, guess) in enumerate(guesses.items(), 1)}
    for key, guess in guesses.items():
        if not guess.certain:
            which = f" (skeleton of {guess.source})" if len(guesses) > 1 else ""
            raise UserError(
                f"{source}: the joint map{which} is not certain: {guess.doubts()}; {written[key]}"
            )
    return guesses


def map_name(number: int) -> str:
    """File name of the map of the n-th skeleton of a source."""
    return "joint_map.json" if number == 1 else f"joint_map-{number}.json"


def guess_source(source: Path, target: Skeleton) -> JointGuess:
    """The guess for the first clip of a .bvh file, of a folder of such files, or of an archive."""
    batches, _ = list_batches(source, SUFFIX)
    for batch in batches:
        for file in batch.read(SUFFIX):
            if file.error:
                raise UserError(f"{file.label}: {file.error}")
            return guess_joint_map(read_bvh(file.data, name=file.label), target)
    raise UserError(f"{source}: no {SUFFIX} file in it")


def _written(guess: JointGuess, number: int, folder: Path | None) -> str:
    """Write the map file; says what to do with it."""
    if folder is None:
        return f"`motionloom data joints {guess.source} -o joint_map.json` writes a map to complete"
    path = folder / map_name(number)
    name = guess.target.name
    if path.exists():
        try:
            rows = json.loads(path.read_text(encoding="utf-8-sig")).get(name)
        except (OSError, ValueError, AttributeError):
            rows = None
        if rows != json.loads(guess.text())[name]:
            raise UserError(
                f"{path}: not the joint map that is guessed; use it with --joint-map {path}, or delete it"
            )
    else:
        write_text(path, guess.text())
    return f"complete {path} and pass it with --joint-map {path}"
