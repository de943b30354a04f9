"""MotionHub: SMPL-H motion of twenty sets at 30 fps, with captions in three depths, music, speech and pairs.

The lists are `annotations/TASK/{train,test}.json` (`data_list`: key -> row). A row names the motion
(`smplh_52/`: poses [T, 156], `trans` or `transl`, betas), the captions (`hierarchical_caption/`: macro, meso,
micro), music or speech, and of one of two people the other's key. A motion that several tasks list is one
clip; one that is for testing in any is for testing in all. The two of a pair are two clips, each moved to its
own place.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import is_file
from motionloom.datasets.base.records import Caption, Split
from motionloom.datasets.base.register import register
from motionloom.datasets.convert.common.facts import Fact
from motionloom.datasets.convert.common.files import inside, read_text_file
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.release import Entry, ReleaseClip
from motionloom.datasets.convert.common.splits import hash_share
from motionloom.datasets.convert.common.tables import captions_of, read_json, require_record
from motionloom.datasets.convert.smpl.body import BodyConfig, BodyRelease

TASKS = ("text_motion", "music_dance", "speech_gesture", "two_person_interaction")
_MIRRORED = re.compile(r"(?<![^/])M(?=\d+(?:/|$))")
"""First letter of a mirrored clip's folder and file: `M000/M000001` mirrors `000/000001`."""
_FACTS = ("genre", "speaker_id", "language", "has_hand", "interactor_key")
"""Fields of a row that are kept as facts."""


class MotionHubConfig(BodyConfig):
    """Options of the MotionHub converter; `source` is the folder that holds annotations/."""

    name: str = "motionhub"
    layout: str = "wholebody313"
    """`wholebody313` with fingers, `body133`, an h3d layout, or `smpl75` for UDE."""
    fps: float = 30.0
    tasks: tuple[str, ...] = TASKS
    """Lists that clips are taken from."""
    subsets: tuple[str, ...] = ()
    """Convert only these subsets (`aist`, `interx`, ...), and read only their captions; empty means all."""
    levels: tuple[str, ...] = ("macro", "meso", "micro")
    """Depths of the captions to keep."""
    script: bool = True
    """Keep the words that are spoken as captions, with source `speech`."""
    val_share: float = 0.02
    """Share of the training clips that become the validation split, by a hash: the set has none."""


class MotionHub(BodyRelease[MotionHubConfig]):
    """The MotionHub converter."""

    name = "motionhub"
    title = "MotionHub"
    summary = "MotionHub: SMPL-H motion with captions, music, speech and pairs to shards."
    example = "MotionHub shards"
    config_class = MotionHubConfig
    terms = "MotionHub, terms of the subset's source"
    model = "SMPL-H"
    published = "card of the release, 2026-07: 1,105,378 clips, 1528 hours"

    def entries(self, draft: ConversionPlan[ReleaseClip]) -> Iterable[Entry]:
        found: dict[str, Entry] = {}
        moved = 0
        for task, split, key, row in self._rows(draft):
            for file in _motions(row):
                if self.config.subsets and file.split("/")[0] not in self.config.subsets:
                    continue
                before = found.get(file)
                if before is None:
                    found[file] = self._entry(file, task, split, key, row, draft)
                    continue
                # A motion of several lists is one clip; testing in any list keeps it from all trainings.
                tasks = before.facts["task"]
                assert isinstance(tasks, tuple)
                moved += split != before.split
                found[file] = replace(
                    before,
                    split="test" if "test" in (split, before.split) else before.split,
                    sound=before.sound or _sound(row),
                    texts=before.texts or tuple(self._texts(row, draft)),
                    facts={**before.facts, "task": tuple(dict.fromkeys((*tasks, task)))},
                )
        if moved:
            draft.notes.append(f"{moved} clips are for training in one list and for testing in another: test")
        for entry in found.values():
            held = entry.split == "train" and hash_share(entry.group) < self.config.val_share
            yield replace(entry, split="val") if held else entry

    def _rows(
        self, draft: ConversionPlan[ReleaseClip]
    ) -> Iterator[tuple[str, Split, str, dict[str, object]]]:
        lists: list[tuple[str, Split]] = [
            (task, split) for task in self.config.tasks for split in ("train", "test")
        ]  # type: ignore[misc]
        here = 0
        for task, split in lists:
            name = f"annotations/{task}/{split}.json"
            path = self.config.source / name
            if not is_file(path):
                draft.notes.append(f"no {name}")
                continue
            draft.known.beside.add(name)
            here += 1
            listed = require_record(read_json(path, name), name).get("data_list")
            rows = enumerate(listed) if isinstance(listed, list) else require_record(listed, name).items()
            for key, row in rows:
                if isinstance(row, dict):
                    yield task, split, str(key), row
                else:
                    draft.mark_unreadable(
                        f"{name}: '{key}'", UserError(f"no JSON object, but {type(row).__name__}")
                    )
        if not here:
            raise UserError(
                f"{self.config.source}: no annotations/{self.config.tasks[0]}/train.json in it; give the "
                f"folder of the release, with annotations/"
            )

    def _entry(
        self,
        file: str,
        task: str,
        split: Split,
        key: str,
        row: dict[str, object],
        draft: ConversionPlan[ReleaseClip],
    ) -> Entry:
        clip_id = file.removesuffix(".npz").replace("/smplh_52/", "/")
        subset = file.split("/")[0]
        plain = _MIRRORED.sub("", clip_id)
        original = plain if plain != clip_id else None
        facts: dict[str, Fact] = {"subset": subset, "task": (task,), "key": key}
        facts |= {name: str(row[name]) for name in _FACTS if row.get(name) is not None}
        return Entry(
            clip_id, file, tuple(self._texts(row, draft)), split, plain, facts, _sound(row),
            mirror_of=original, licence=f"MotionHub, terms of {subset}",
        )  # fmt: skip

    def _texts(self, row: dict[str, object], draft: ConversionPlan[ReleaseClip]) -> Iterator[Caption]:
        source = self.config.source
        for field in ("hierarchical_caption_path", "speech_script_path"):
            name = row.get(field)
            if not isinstance(name, str):
                continue
            with draft.reading(name):
                path = inside(source, name)
                if field == "speech_script_path":
                    yield from captions_of(read_text_file(path, name), "speech") if self.config.script else ()
                    continue
                levels = require_record(read_json(path, name), name)
                for level in self.config.levels:
                    yield from captions_of(levels.get(level), level)


def _motions(row: dict[str, object]) -> Iterator[str]:
    """The motion files of a row: one, or one for each person."""
    stated = next((row[name] for name in ("smplh_path", "smplx_path", "motion_path") if row.get(name)), None)
    for file in stated if isinstance(stated, list) else [stated]:
        if isinstance(file, str):
            yield file.removeprefix("./")


def _sound(row: dict[str, object]) -> str | None:
    stated = row.get("music_path") or row.get("audio_path")
    return stated if isinstance(stated, str) else None


register(MotionHub)
