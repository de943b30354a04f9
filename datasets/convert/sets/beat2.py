"""BEAT2: people who talk, with face; SMPL-X .npz and 100 FLAME expressions at 30 fps, speech and transcripts.

`beat_LANGUAGE_v2.0.0/` holds `smplxflame_30/NAME.npz` (poses [T, 165], expressions [T, 100], trans, betas),
`wave16k/NAME.wav`, `textgrid/NAME.TextGrid` and `train_test_split.csv`. The first 50 expressions are the
face's columns, as they are: both are the first of FLAME's basis. NAME is `NUMBER_SPEAKER_KIND_FIRST_LAST`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import is_file
from motionloom.datasets.base.json_doors import number
from motionloom.datasets.base.records import Caption, Split
from motionloom.datasets.base.register import register
from motionloom.datasets.convert.common.arrays import check_values
from motionloom.datasets.convert.common.facts import Fact
from motionloom.datasets.convert.common.files import files_in, read_text_file
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.release import Entry, Figure, ReleaseClip
from motionloom.datasets.convert.common.tables import BadRows, captions_of, read_csv
from motionloom.datasets.convert.smpl.body import BodyConfig, BodyRelease
from motionloom.datasets.motion.layout import FACE_DIMS
from motionloom.datasets.motion.npz import NpzFile

MOTION = "smplxflame_30"
SPEECH = "wave16k"
WORDS = "textgrid"
LISTS = "train_test_split.csv"
_SPLITS: dict[str, Split] = {"train": "train", "val": "val", "test": "test"}
_ITEM = re.compile(r"^[ \t]*item[ \t]*\[", re.MULTILINE)
"""Where a tier begins. `\\s` would run over empty lines, and over all of them again from each."""
_NAME = re.compile(r'name\s*=\s*"words"(.*)', re.DOTALL)
_WORD = re.compile(r'xmin\s*=\s*([\d.]+)\s+xmax\s*=\s*([\d.]+)\s+text\s*=\s*"((?:[^"]|"")*)"')


class Beat2Config(BodyConfig):
    """Options of the BEAT2 converter; `source` is BEAT2/, or the folder of one language."""

    layouts = ("wholebody363", *BodyConfig.layouts)

    name: str = "beat2"
    layout: str = "wholebody363"
    """`wholebody363` with fingers and face, or one without."""
    fps: float = 30.0
    pause: float = 0.5
    """Seconds of silence that end a phrase; what is said becomes a caption a phrase, with source `speech`."""


class Beat2(BodyRelease[Beat2Config]):
    """The BEAT2 converter."""

    name = "beat2"
    title = "BEAT2"
    summary = "BEAT2: talking people with face, speech and transcripts to shards."
    example = "BEAT2 shards"
    config_class = Beat2Config
    terms = "BEAT2-noncommercial"
    model = "SMPL-X"
    published = "EMAGE paper, CVPR 2024: 60 hours, 25 speakers"

    def entries(self, draft: ConversionPlan[ReleaseClip]) -> Iterable[Entry]:
        source = self.config.source
        folders = sorted(
            path.parent for path in [source / MOTION, *source.glob(f"*/{MOTION}")] if path.is_dir()
        )
        if not folders:
            raise UserError(
                f"{source}: no {MOTION}/ in it nor in its folders; give BEAT2/, or one language's"
            )
        for folder in folders:
            below = "" if folder == source else f"{folder.name}/"
            listed = {}
            if is_file(folder / LISTS):
                draft.known.beside.add(f"{below}{LISTS}")
                bad: BadRows = {}
                rows = read_csv(folder / LISTS, ("id", "type"), bad)
                listed = {row["id"].strip(): row["type"].strip() for _, row in rows}
                draft.mark_rows_unreadable({f"{below}{place}": reason for place, reason in bad.items()})
            else:
                draft.notes.append(f"no {below}{LISTS}: split 80/5/15 by hash of the name")
            language = folder.name.removeprefix("beat_").split("_v")[0]
            here = {name.removesuffix(".npz") for name in files_in(folder / MOTION, ".npz")}
            for name in sorted({*here, *listed}):
                yield self._entry(below, name, language, listed.get(name), bool(listed), draft)

    def _entry(
        self,
        below: str,
        name: str,
        language: str,
        kind: str | None,
        has_list: bool,
        draft: ConversionPlan[ReleaseClip],
    ) -> Entry:
        facts: dict[str, Fact] = {"language": language, "type": kind or ""}
        parts = name.split("_")
        if len(parts) >= 2 and re.fullmatch("[0-9]{1,9}", parts[0]):
            facts |= {"speaker_id": number(parts[0], name), "speaker": f"{parts[0]}_{parts[1]}"}
        problem = ""
        if has_list and kind is None:
            problem = f"not in {LISTS}"
        split: Split | None = "train" if kind == "additional" else _SPLITS.get(kind or "")
        sound = f"{below}{SPEECH}/{name}.wav"
        texts = tuple(self._words(below, name, draft))
        return Entry(
            f"{below}{name}", f"{below}{MOTION}/{name}.npz", texts, split, name, facts,
            sound if is_file(self.config.source / sound) else None, problem=problem,
        )  # fmt: skip

    def _words(self, below: str, name: str, draft: ConversionPlan[ReleaseClip]) -> Iterator[Caption]:
        """Yield the transcript, a caption for each phrase between two pauses."""
        file = f"{below}{WORDS}/{name}.TextGrid"
        path = self.config.source / file
        if not is_file(path):
            return
        words: list[tuple[float, float, str]] = []
        with draft.reading(file):
            tier = next(filter(None, map(_NAME.search, _ITEM.split(read_text_file(path, file)))), None)
            if tier is None:
                raise UserError(f'{file}: no tier "words" in it')
            found = _WORD.findall(tier[1])
            words = [(number(a, file), number(b, file), text.strip()) for a, b, text in found if text.strip()]
        phrase: list[str] = []
        start = end = 0.0
        for begin, stop, word in words:
            if phrase and begin - end > self.config.pause:
                yield from captions_of(" ".join(phrase), "speech", start, end)
                phrase = []
            start = start if phrase else begin
            end = stop
            phrase = [*phrase, word]
        yield from captions_of(" ".join(phrase), "speech", start, end)

    def figure(self, clip: ReleaseClip) -> Figure:
        figure = super().figure(clip)
        label = clip.entry.file
        with NpzFile(self.path_of(label), label) as file:
            face = (
                file.numbers("expressions")
                if "expressions" in file.names
                else np.zeros((len(figure), FACE_DIMS))
            )
        if face.ndim != 2 or len(face) != len(figure) or face.shape[1] < FACE_DIMS:
            raise UserError(
                f"{label}: expressions is {list(face.shape)}, not [{len(figure)}, {FACE_DIMS} or more]"
            )
        check_values(face, 1e3, f"{label}: expressions")
        return replace(figure, face=face[:, :FACE_DIMS])


register(Beat2)
