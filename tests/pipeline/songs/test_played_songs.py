"""Songs that a band plays: known beats, breaks that are heard, the same sound each time."""

from __future__ import annotations

import numpy as np
import pytest

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.synth.music.recording import render_song
from motionloom.datasets.synth.music.song import Song, draw_song
from motionloom.pipeline.songs import band
from motionloom.pipeline.songs.band import band_version, sound_font

RATE = 16_000


def songs(count: int, seconds: float = 20.0) -> list[Song]:
    return [draw_song(number, 5, tempo=(60, 190), seconds=seconds, played=True) for number in range(count)]


def test_forms_have_intros_loud_and_quiet_sections_and_breaks() -> None:
    found = songs(60, seconds=60.0)
    energies = [section.energy for song in found for section in song.form]
    assert min(energies) == 0.0 and max(energies) > 0.9
    assert {song.meter for song in found} == {3, 4}
    spread = [np.ptp(np.diff(song.beats_within(0, 60))) / song.beat for song in found]
    assert 0.3 < np.mean(np.array(spread) > 0.01) < 0.7  # half of the bands have no click


def test_beats_within_are_those_of_the_grid() -> None:
    for song in songs(10):
        numbers = np.arange(-8, int(20 / song.beat) + 8)
        times = song.times(numbers)
        assert (np.diff(times) > 0).all()
        start = 3.21
        expected = [t - start for t in times.tolist() if start <= t < start + 5]
        assert song.beats_within(start, 5) == pytest.approx(expected, abs=1e-8)
        first = song.beat_number(start)
        assert song.times(first) >= start - 1e-9 > song.times(first - 1)


def test_the_same_song_is_the_same_sound() -> None:
    try:
        band_version()
    except UserError as error:
        pytest.skip(str(error))
    (song,) = songs(1, seconds=6.0)
    first = render_song(song, RATE).copy()
    render_song.cache_clear()
    assert len(first) == 6 * RATE and np.abs(first).max() <= 1.0
    assert np.array_equal(first, render_song(song, RATE))


def test_strokes_fall_on_the_grid_and_a_break_rings() -> None:
    straight, breaks = 0, 0
    for song in songs(12):
        sixteenths = song.times(np.arange(-32, 4 * int(20 / song.beat)) / 4)
        how = band.LineUp.drawn(song, np.random.default_rng([song.seed, song.number, 241]))
        struck = np.array([note.at for note in band.score(song) if note.at < 18])
        late = (struck - sixteenths[np.searchsorted(sixteenths, struck + 1e-9) - 1]) / song.beat
        straight += how.swing == 0.0
        assert (late < 1e-6).all() == (how.swing == 0.0) and late.max() < how.swing / 2 + 1e-6
        for beat in range(1, int(18 / song.beat)):
            # Within a break nothing is struck.
            if song.section_of(beat).energy == 0.0 == song.section_of(beat - 1).energy:
                breaks += 1
                begin, end = song.times([beat, beat + 1])
                assert not ((struck > begin - 1e-6) & (struck < end - 1e-6)).any()
    assert straight and breaks


def test_without_a_sound_font_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MOTIONLOOM_SOUND_FONT", "nowhere.sf2")
    with pytest.raises(UserError, match=r"nowhere\.sf2.*MOTIONLOOM_SOUND_FONT"):
        sound_font()
