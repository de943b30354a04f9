"""Dances to songs: music decides the dance, both can be read back, songs are kept apart, bytes repeat."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np
import pytest

from motionloom.datasets.actions.dances import longest_stand
from motionloom.datasets.actions.measure import agrees
from motionloom.datasets.audio.features import audio_features, settings_at
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.synth.choreography import choreograph
from motionloom.datasets.synth.dances import DanceConditions, DanceConfig
from motionloom.datasets.synth.generate import Clip, SynthConfig, dance_of, make_clip, make_sample, split_of
from motionloom.datasets.synth.music.genres import GENRES
from motionloom.datasets.synth.music.recording import player, render_song
from motionloom.datasets.synth.music.song import Song, draw_song
from motionloom.models.metrics.dance import foot_skating
from motionloom.models.metrics.dance_beats import beat_align

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
    stands = [(clip.truth["style"], longest_stand(clip.joints, FPS)) for clip in clips]
    assert np.median([still for style, still in stands if style == "step"]) < 0.5
    assert max(still for style, still in stands if style != "step") > 3
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
    dances = DanceConfig(songs=40, hold_out_tempi=[(110, 119)])
    config = SynthConfig(actions=["dance"], clips=400, test_fraction=0.25, val_fraction=0.1, dances=dances)
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
    dances = DanceConfig(songs=3, song_seconds=6.0, share=0.5, conditions=conditions)
    config = SynthConfig(layout="body133", actions=["walk", "clap"], clips=16, dances=dances)
    kinds = Counter()
    for index in range(16):
        sample = make_sample(index, config)
        kinds[bool(sample.texts), sample.audio is not None] += 1
        assert ("genre" in (sample.meta.truth or {})) == (index % 2 == 1)
    assert set(kinds) == {(True, True), (True, False), (False, True), (False, False)}


# How dances follow a song's form: on its beats, as large as it is loud, still in breaks, feet that stand.

RATE, COUNT = 20.0, 500
SONGS = [draw_song(number, 5, tempo=(70, 160), seconds=40.0, played=True) for number in range(12)]


def danced(song: Song) -> np.ndarray:
    return choreograph(song, 5.0, COUNT, RATE, np.random.default_rng(song.number)).solve()[:, :22]


def test_dances_to_drifting_songs_have_their_beats_and_no_others() -> None:
    assert {song.meter for song in SONGS} == {3, 4}
    scores = defaultdict(list)
    for song in SONGS:
        beats = np.array(song.beats_within(5.0, COUNT / RATE - 1))
        for definition in ("bailando", "mint"):
            for shift in (0.0, 0.5):
                score = beat_align(danced(song), beats + shift * song.beat, RATE, definition)
                scores[definition, shift].append(score)
    # Sampling at 20 frames a second leaves 0.86 of a perfect score.
    assert min(np.mean(scores[name, 0.0]) for name in ("bailando", "mint")) > 0.75
    assert max(np.mean(scores[name, 0.5]) for name in ("bailando", "mint")) < 0.15


def test_size_follows_the_energy_and_a_break_is_held() -> None:
    speeds = defaultdict(list)
    for song in SONGS:
        joints = danced(song)
        speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1).mean(1) * RATE
        assert foot_skating(joints, RATE) < 0.01
        for frame, value in enumerate(speed):
            beat = song.beat_number(5.0 + (frame + 0.5) / RATE) - 1
            around = [song.section_of(beat + away).energy for away in (-1, 0, 1)]
            if max(around) == 0:
                speeds["break"].append(value)
            elif min(around) > 0:
                speeds["loud" if around[1] > 0.8 else "quiet" if around[1] < 0.45 else ""].append(value)
    assert np.mean(speeds["loud"]) > 1.7 * np.mean(speeds["quiet"])
    assert np.mean(speeds["break"]) < 0.3 * np.mean(speeds["quiet"])


def test_songs_of_an_unknown_player_are_refused_in_one_sentence() -> None:
    with pytest.raises(UserError, match="music 'nobody'"):
        player("nobody")
