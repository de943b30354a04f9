"""How dances follow a song's form: on its beats, as large as it is loud, still in breaks, feet that stand."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from motionloom.datasets.synth.choreography import choreograph
from motionloom.datasets.synth.music.genres import GENRES
from motionloom.datasets.synth.music.song import Song, draw_song
from motionloom.models.metrics.dance import foot_skating
from motionloom.models.metrics.dance_beats import beat_align

FPS, FRAMES = 20.0, 500
SONGS = [
    draw_song(number, 5, genres=tuple(GENRES), tempo=(70, 160), seconds=40.0, played=True)
    for number in range(12)
]


def danced(song: Song) -> np.ndarray:
    return choreograph(song, 5.0, FRAMES, FPS, np.random.default_rng(song.number)).solve()[:, :22]


def test_dances_to_drifting_songs_have_their_beats_and_no_others() -> None:
    assert {song.meter for song in SONGS} == {3, 4}
    scores = defaultdict(list)
    for song in SONGS:
        beats = np.array(song.beats_within(5.0, FRAMES / FPS - 1))
        for definition in ("ude", "mint"):
            for shift in (0.0, 0.5):
                score = beat_align(danced(song), beats + shift * song.beat, FPS, definition)
                scores[definition, shift].append(score)
    # Sampling at 20 frames a second leaves 0.86 of a perfect score.
    assert min(np.mean(scores[name, 0.0]) for name in ("ude", "mint")) > 0.75
    assert max(np.mean(scores[name, 0.5]) for name in ("ude", "mint")) < 0.15


def test_size_follows_the_energy_and_a_break_is_held() -> None:
    speeds = defaultdict(list)
    for song in SONGS:
        joints = danced(song)
        speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1).mean(1) * FPS
        assert foot_skating(joints, FPS) < 0.01
        for frame, value in enumerate(speed):
            beat = song.beat_number(5.0 + (frame + 0.5) / FPS) - 1
            around = [song.energy(beat + away) for away in (-1, 0, 1)]
            if max(around) == 0:
                speeds["break"].append(value)
            elif min(around) > 0:
                speeds["loud" if around[1] > 0.8 else "quiet" if around[1] < 0.45 else ""].append(value)
    assert np.mean(speeds["loud"]) > 1.7 * np.mean(speeds["quiet"])
    assert np.mean(speeds["break"]) < 0.3 * np.mean(speeds["quiet"])
