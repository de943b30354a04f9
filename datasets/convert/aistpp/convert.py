"""AIST++ -> shards: SMPL dances at 60 fps with their music (UDE section 4.1).

`motions/SEQUENCE.pkl` are the annotations, `splits/crossmodal_{train,val,test}.txt` and `ignore_list.txt` the
lists, `wavs/` the music: `SEQUENCE.wav`, or `MUSIC.wav` for every dance to a piece; `music=band` plays other
music in its place. Metres are smpl_trans /
smpl_scaling. The floor of the source is anywhere: like every other source, a clip is moved to the canonical
place (floor 0, first root above the origin, first heading +Z).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Caption, Split
from motionloom.datasets.base.register import register
from motionloom.datasets.convert.aistpp.accompaniment import GENRES, TEMPI, song_for
from motionloom.datasets.convert.aistpp.pickle_reader import read_aist_motion
from motionloom.datasets.convert.common.files import files_in
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.release import Entry, Figure, ReleaseClip
from motionloom.datasets.convert.common.splits import read_ids
from motionloom.datasets.convert.smpl.body import SOUND_SUFFIXES, BodyConfig, BodyRelease, analyse, cut_of
from motionloom.datasets.motion.features.smpl75 import SMPL_JOINTS
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.synth.music.recording import PLAYED, player, render_song

FPS = 60.0
MOTIONS = "motions"
BAND_RATE = 32_000
"""Hz at which the band is recorded; one that every codec of its recordings knows."""
MOTION_LICENCE = "CC-BY-4.0"
MUSIC_LICENCE = "CC-BY-4.0 AND LicenseRef-AIST-Dance-DB"
"""Annotations: CC BY 4.0. Music: the terms of use of the AIST Dance Video Database, which no converter can
grant; shards that hold sound, or features made from it, stand under both.
"""

_SEQUENCE = re.compile(
    r"g(?P<genre>[A-Z]{2})_s(?P<situation>[A-Z]{2})_c(?:All|\d\d)_d(?P<dancer>\d+)_(?P<music>m[A-Z]{2}\d+)"
    r"_ch(?P<choreography>\d+)"
)
"""Genre `BR` and music `mBR0` of `gBR_sBM_cAll_d04_mBR0_ch01`; the situation is BM, basic, or FM, advanced.
"""


class AistppConfig(BodyConfig):
    """Options of the AIST++ converter; `source` is the folder of the annotations, with motions/ in it."""

    layouts = ("body133", "h3d263", "smpl75")

    name: str = "aistpp"
    layout: str = "body133"
    """`body133` or `h3d263` from the joints, or `smpl75`: UDE's translation and axis-angles."""
    splits: Path | None = None
    """Folder of crossmodal_train.txt, _val.txt and _test.txt; default: splits/ in the source."""
    sound: Literal["optional", "require", "none"] = "require"
    """Whether a sequence needs its music; `none` converts the motion alone."""
    music: Literal["release", "band"] = "release"
    """`band` plays music of ours at the tempo and phase of each dance in place of AIST's, which may not be
    passed on: clips are then under CC BY 4.0 alone. Needs FluidSynth (`pip install 'motionloom[band]'`)."""
    music_folder: Path | None = None
    """Folder of `<sequence>.wav` or `<music>.wav` (also flac, mp3, ogg); default: wavs/ in the source."""
    caption_genre: bool = False
    """Give every clip the caption "a dancer performs ...", by the genre in its name."""

    @property
    def stores_music(self) -> bool:
        """Whether shards hold AIST's songs, or features of them."""
        heard = self.sound != "none" and (self.audio_features or self.sound_rate > 0)
        return heard and self.music == "release"

    @property
    def has_band(self) -> bool:
        """Whether a band plays to the dances."""
        return self.sound != "none" and self.music == "band"


class Aistpp(BodyRelease[AistppConfig]):
    """The AIST++ converter."""

    name = "aistpp"
    title = "AIST++"
    summary = "AIST++: SMPL dances with their music to shards."
    example = "aist_plusplus_final shards"
    config_class = AistppConfig
    terms = MOTION_LICENCE
    credit = "Motion of AIST++ (Li, Yang, Ross and Kanazawa, ICCV 2021), Google LLC, CC BY 4.0."
    model = "SMPL"
    lists = ("splits",)

    def __init__(self, config: AistppConfig) -> None:
        super().__init__(config)
        self.sound_folder = config.music_folder or config.source / "wavs"
        self.ignored: set[str] = set()
        """Sequences of `ignore_list.txt`."""

    def entries(self, draft: ConversionPlan[ReleaseClip]) -> Iterable[Entry]:
        folder = self.config.source / MOTIONS
        if not folder.is_dir():
            raise UserError(
                f"{self.config.source}: no {MOTIONS}/ in it; give the folder of the AIST++ annotations"
            )
        music = self._music()
        for name in (file.removesuffix(".pkl") for file in files_in(folder, ".pkl")):
            match = _SEQUENCE.fullmatch(name)
            file = f"{MOTIONS}/{name}.pkl"
            if match is None:
                draft.mark_unreadable(file, UserError("not an AIST++ name like gBR_sBM_cAll_d04_mBR0_ch01"))
                continue
            facts = match.groupdict()
            problem = "on the ignore list" if name in self.ignored else ""
            if self.config.has_band and facts["music"] not in TEMPI:
                problem = f"no tempo is known of music '{facts['music']}'; AIST's pieces are mBR0 to mJB5"
            genre, _ = GENRES.get(facts["genre"], (f"{facts['genre']} dance", ""))
            caption = Caption(text=f"a dancer performs {genre}", source="genre")
            # By music: pieces are shared by many dances, and one in two splits would leak.
            yield Entry(
                name, file, (caption,) if self.config.caption_genre else (),
                group=facts["music"], facts=dict(facts),
                sound=music.get(name) or music.get(facts["music"]),
                problem=problem,
            )  # fmt: skip

    def split_lists(self, draft: ConversionPlan[ReleaseClip]) -> dict[str, Split] | None:
        """Return the splits, without the sequences of `ignore_list.txt`."""
        listed = super().split_lists(draft)
        path = self.config.source / "ignore_list.txt"
        if path.is_file():
            ids, repeated = read_ids(path)
            self.ignored = set(ids)
            draft.notes += [f"{line.place}: {line.reason}" for line in repeated]
            draft.known.beside.add(path.name)
        else:
            draft.notes.append("no ignore_list.txt: bad sequences are not left out")
        if both := sorted(self.ignored & (listed or {}).keys()):
            some = ", ".join(both[:3])
            draft.notes.append(f"{len(both)} sequences of the split files are on the ignore list: {some}")
        return listed and {name: split for name, split in listed.items() if name not in self.ignored}

    def _music(self) -> dict[str, str]:
        """Music files by name without suffix, with their folder."""
        folder = self.sound_folder
        sound = self.config.sound
        if sound == "none" or self.config.has_band:
            return {}
        if not folder.is_dir():
            if sound == "require" or self.config.music_folder is not None:
                raise UserError(
                    f"{folder}: no such folder of music; --set music_folder=FOLDER, or --set sound=none"
                )
            return {}
        names = [Path(name) for name in files_in(folder, "") if name.lower().endswith(SOUND_SUFFIXES)]
        return {name.stem: str(name) for name in reversed(names)}

    def with_sound(self, entries: Sequence[Entry], draft: ConversionPlan[ReleaseClip]) -> Iterable[Entry]:
        if self.config.has_band:
            yield from entries
            return
        for entry in super().with_sound(entries, draft):
            heard = entry.sound is not None and self.config.stores_music
            yield replace(entry, licence=MUSIC_LICENCE if heard else None)

    def licence(self, plan: ConversionPlan[ReleaseClip]) -> str:
        return self.config.licence or (MUSIC_LICENCE if self.config.stores_music else MOTION_LICENCE)

    def subset(self, clip: ReleaseClip) -> str:
        return str(clip.entry.facts["genre"])

    def song(self, clip: ReleaseClip) -> str:
        return clip.id if self.config.has_band else str(clip.entry.facts["music"])

    def options(self) -> dict[str, object]:
        return super().options() | ({"band": player(PLAYED).version()} if self.config.has_band else {})

    def convert(self, clip: ReleaseClip) -> Sample:
        sample = super().convert(clip)
        config = self.config
        if not config.has_band:
            return sample
        facts = clip.entry.facts
        joints = self.posed(self.read(clip))
        song = song_for(clip.id, str(facts["genre"]), str(facts["music"]), joints, clip.fps)
        sound = render_song.__wrapped__(song, BAND_RATE)
        piece = analyse(sound, BAND_RATE, config.audio_settings(), config.fps, config.sound_rate)
        audio, wav = cut_of(config, piece, 0.0, len(sample.motion) / config.fps)
        # What plays is known, and need not be heard again by a beat tracker.
        truth = {"bpm": song.bpm, "first_beat": song.first}
        return replace(sample, meta=sample.meta.model_copy(update={"truth": truth}), audio=audio, wav=wav)

    def length(self, path: Path, label: str) -> tuple[int, float]:
        return len(read_aist_motion(path, label)[0]), FPS

    def figure(self, clip: ReleaseClip) -> Figure:
        label = clip.entry.file
        poses, trans = read_aist_motion(self.path_of(label), label)
        return Figure(rotations=poses.reshape(-1, SMPL_JOINTS, 3).astype(np.float64), trans=trans)


register(Aistpp)
