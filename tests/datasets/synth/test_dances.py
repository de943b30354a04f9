"""Dances to songs: music decides the dance, both can be read back, songs are kept apart, bytes repeat."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np
import pytest

from motionloom.datasets.actions.dances import measure_dance
from motionloom.datasets.actions.measure import agrees
from motionloom.datasets.audio.features import audio_features, settings_at
from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.canonical import canonicalize, facing
from motionloom.datasets.synth.dances import DanceConditions, DanceConfig
from motionloom.datasets.synth.generate import Clip, SynthConfig, dance_of, make_clip, make_sample, split_of
from motionloom.datasets.synth.music.genres import GENRES
from motionloom.datasets.synth.music.recording import render_song

FPS = 20.0
CONFIG = SynthConfig(
    seed=11,
    fps=FPS,
    actions=["dance"],
    min_seconds=5.0,
    max_seconds=8.0,
    clips=36,
    dances=DanceConfig(songs=18, song_seconds=12.0),
)


@pytest.fixture(scope="module")
def clips() -> list[Clip]:
    return [make_clip(index, CONFIG) for index in range(CONFIG.clips)]


def test_motion_and_words_say_the_genre_tempo_hands_and_face(clips: list[Clip]) -> None:
    assert {clip.truth["genre"] for clip in clips} == set(GENRES)
    right: dict[str, list[bool]] = defaultdict(list)
    for clip in clips:
        for attribute, good in agrees(clip.truth, clip.joints, clip.face, FPS).items():
            right[attribute].append(good)
    assert set(right) == {"action", "bpm", "style", "genre", "left_hand", "right_hand", "face"}
    assert {name: np.mean(values) for name, values in right.items() if np.mean(values) < 0.97} == {}
    for clip in clips:
        genre = GENRES[clip.truth["genre"]]
        assert clip.truth["style"] == genre.style
        assert len(set(clip.texts)) == 3
        for text in clip.texts:
            assert any(word in text for word in (*genre.words, *genre.moves))


def test_audio_rows_belong_to_motion_frames(clips: list[Clip]) -> None:
    for index, clip in enumerate(clips[:6]):
        dance = dance_of(index, CONFIG)
        assert dance is not None
        assert clip.audio is not None
        assert clip.wav is not None
        assert clip.audio.shape == (len(clip.joints), 438)
        whole = audio_features(render_song(dance.song, 16_000), 16_000, settings_at(FPS))
        assert np.array_equal(clip.audio, whole[dance.start : dance.start + dance.frames])
        sound, rate = clip.wav
        first = round(dance.start / FPS * rate)
        assert np.array_equal(sound, render_song(dance.song, rate)[first : first + len(sound)])
        assert abs(len(sound) / rate - len(clip.joints) / FPS) < 1 / rate + 1e-9


def test_songs_never_cross_splits() -> None:
    dances = DanceConfig(songs=40, hold_out_songs=0.25, hold_out_tempi=[(110, 119)])
    config = SynthConfig(actions=["dance"], clips=400, val_fraction=0.1, dances=dances)
    songs: dict[str, set[int]] = defaultdict(set)
    bpm: dict[str, set[int]] = defaultdict(set)
    for index in range(400):
        dance = dance_of(index, config)
        assert dance is not None
        split = split_of(index, config)
        songs[split].add(dance.song.number)
        bpm[split].add(dance.song.bpm)
    assert sum(map(len, songs.values())) == len(set.union(*songs.values())) == 40
    assert set(range(10)) <= songs["test"]
    assert not any(110 <= tempo <= 119 for split in ("train", "val") for tempo in bpm[split])
    assert any(110 <= tempo <= 119 for tempo in bpm["test"])
    assert songs["val"] <= set(range(10, 14))


def test_clips_come_with_what_the_shares_say() -> None:
    conditions = DanceConditions(text=1, audio=2, both=4, none=1)
    found = Counter(conditions.of(number) for number in range(800))
    for name, share in {"text": 100, "audio": 200, "both": 400, "none": 100}.items():
        assert abs(found[name] - share) <= 2  # type: ignore[index]
    dances = DanceConfig(songs=3, song_seconds=6.0, share=0.5, conditions=conditions, sound=False)
    config = SynthConfig(layout="body133", actions=["walk", "clap"], clips=16, dances=dances)
    kinds = Counter()
    for index in range(16):
        sample = make_sample(index, config)
        kinds[bool(sample.texts), sample.audio is not None] += 1
        assert sample.wav is None
        assert ("genre" in (sample.meta.truth or {})) == (index % 2 == 1)
    assert set(kinds) == {(True, True), (True, False), (False, True), (False, False)}


def test_smpl_columns_pose_the_joints_of_the_clip() -> None:
    body = BodyModel.neutral("smpl22")
    config = SynthConfig(
        layout="smpl75", clips=28, seed=4, dances=DanceConfig(songs=2, song_seconds=8.0, share=0.25)
    )
    assert config.motion_layout.fps == 20
    for index in range(28):
        clip, sample = make_clip(index, config), make_sample(index, config)
        values = sample.motion.astype(np.float64)
        assert values.shape == (len(clip.joints), 75)
        assert not sample.meta.has_hands
        joints = smpl_joints(values[:, 3:].reshape(-1, 24, 3)[:, :22], values[:, :3], body)
        # float32 columns: 2e-3 mm is rounding, nothing is fitted.
        assert np.abs(joints - clip.joints).max() < 2e-6
        assert np.abs(joints - canonicalize(joints)).max() < 2e-6
        assert abs(float(facing(joints[:1])[0])) < 1e-5
        assert np.linalg.norm(values[:, 3:].reshape(-1, 3), axis=-1).max() < np.pi + 1e-6
        if clip.truth.get("genre"):
            assert measure_dance(joints, 20.0).genre == clip.truth["genre"]
