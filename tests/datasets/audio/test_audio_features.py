"""Audio features against the golden vectors and against librosa's own functions in the published order."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from motionloom.datasets.audio import onsets, spectra, tracker
from motionloom.datasets.audio.beat_net import (
    ROWS,
    WEIGHTS,
    BeatNet,
    BeatNetConfig,
    activations,
    band_from,
    band_power,
    levels,
    read_beat_net,
)
from motionloom.datasets.audio.features import (
    BEAT,
    DIM,
    AudioSettings,
    audio_features,
    beats,
    features_of,
    fitting_octaves,
    rows_at,
    settings_at,
)
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.datasets.synth.music.recording import render_song
from motionloom.datasets.synth.music.song import Song
from motionloom.pipeline.contract.generation import Prompt


def published(samples: NDArray[np.float32], rate: int, octaves: int) -> NDArray[np.float32]:
    """The 438 columns in the order and with the settings of the published extractor, by librosa alone."""
    import librosa

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mel = librosa.power_to_db(librosa.feature.melspectrogram(y=samples, sr=rate), ref=np.max)
        mfcc = librosa.feature.mfcc(S=mel)
        harmonic, percussive = librosa.effects.hpss(samples)
        notes = librosa.feature.chroma_cqt(y=harmonic, sr=rate, n_octaves=octaves)
        onsets = librosa.onset.onset_strength(y=percussive, sr=rate, aggregate=np.median)
        _, found = librosa.beat.beat_track(onset_envelope=onsets, sr=rate)
        flags = np.zeros_like(onsets)
        flags[found] = 1
        tempogram = librosa.feature.tempogram(onset_envelope=onsets, sr=rate)
    delta = librosa.feature.delta(mfcc, width=3)
    parts = [mfcc, delta, notes, onsets[None], flags[None], tempogram]
    return np.concatenate(parts).T.astype(np.float32)


def song(seconds: float, rate: int, seed: int, bpm: float = 110.0) -> NDArray[np.float32]:
    """Drum noise and decaying notes on the beat, from the first sample to the last."""
    rng = np.random.default_rng(seed)
    out = 0.01 * rng.standard_normal(int(seconds * rate))
    for beat in range(int(seconds * bpm / 60)):
        start = int(beat * 60 / bpm * rate)
        time = np.arange(min(len(out) - start, int(0.3 * rate))) / rate
        note = 55 * 2 ** (rng.integers(0, 36) / 12 + 0.004)
        out[start : start + len(time)] += 0.3 * np.exp(-20 * time) * rng.standard_normal(len(time))
        out[start : start + len(time)] += 0.3 * np.exp(-6 * time) * np.sin(2 * np.pi * note * time)
    return out.astype(np.float32)


@pytest.fixture(scope="module")
def golden(shared: Path) -> dict[str, NDArray]:
    with np.load(shared / "golden" / "t5_audio_A.npz", allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays}


def test_beats_are_those_of_the_music_after_normalising_and_back() -> None:
    draws, truth = np.random.default_rng(0), np.arange(0, 240, 31)
    for _ in range(200):
        rows = draws.normal(size=(240, DIM)).astype(np.float32)
        rows[:, BEAT] = 0
        rows[truth, BEAT] = 1
        mean, std = (draws.uniform(0.01, 1, DIM).astype(np.float32) for _ in range(2))
        back = (rows - mean) / std * std + mean
        assert np.allclose(MODALITIES["audio"].ticks(None, back, 20.0), truth / 20)


def test_438_columns_equal_the_golden_ones(golden: dict[str, NDArray]) -> None:
    samples = golden["syn_wav"].astype(np.float32) / 32768
    found = audio_features(samples, int(golden["syn_sr"]))
    want = golden["syn_feat438_60fps"]
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-3)
    np.testing.assert_array_equal(found[:, 53], want[:, 53])
    slow = audio_features(golden["syn_wav_3840"], 3840, AudioSettings(fps=7.5))
    np.testing.assert_allclose(slow, golden["syn_feat438_7p5fps"], rtol=0, atol=1e-3)
    np.testing.assert_allclose(beats(samples, 30720), np.flatnonzero(want[:, 53]) / 60)
    resampled = audio_features(samples, 30720, AudioSettings(fps=7.5))
    np.testing.assert_allclose(resampled, golden["syn_feat438_7p5fps"], rtol=0, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("fps", "seconds"), [(60.0, 4.03), (20.0, 12.9), (240.0, 2.0), (5.0, 11.3)])
def test_equal_to_librosa(fps: float, seconds: float) -> None:
    settings = AudioSettings(fps=fps)
    samples = song(seconds, settings.rate, seed=int(fps), bpm=70 + fps)
    want = published(samples, settings.rate, fitting_octaves(settings.rate))
    found = audio_features(samples, settings.rate, settings)
    # MFCC are in hundreds of decibels.
    assert (np.abs(found - want) <= 1e-5 * np.maximum(1.0, np.abs(want).max(axis=0))).all()


@pytest.mark.slow
def test_silence_is_equal_to_librosa_and_has_no_notes_or_beats() -> None:
    silence = np.zeros(30720, dtype=np.float32)
    found = audio_features(silence, 30720)
    np.testing.assert_allclose(found, published(silence, 30720, 7), rtol=0, atol=1e-3)
    assert not found[:, 40:].any() and not len(beats(silence, 30720))
    quarter = song(4.0, 30720, seed=1)
    quarter[30720:] = 0
    after = audio_features(quarter, 30720)[140:]  # the longest filters reach 1.07 s
    assert not after[:, 40:52].any(), "rounding is not scaled up to notes"


def test_pieces_leave_no_seams(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a piece ends with the sound: 180 frames are 4 pieces of 45, the last one is a fifth."""
    samples = song(3.0, 30720, seed=2)
    assert len(samples) == 180 * 512
    want = audio_features(samples, 30720)
    for size in (1, 7, 45, 1000):
        monkeypatch.setattr(spectra, "_PIECE", size)
        monkeypatch.setattr(onsets, "_BLOCK", size)
        np.testing.assert_allclose(audio_features(samples, 30720), want, rtol=0, atol=5e-4)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_beats_equal_librosas(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tempo comes from a mean that is taken in blocks; librosa's own holds every tempogram at once."""
    import librosa

    rng = np.random.default_rng(seed)
    fps = float(rng.choice([7.5, 20, 30, 60]))
    strength = np.abs(rng.standard_normal(int(rng.integers(40, 2000)))).astype(np.float32)
    strength[:: int(0.5 * fps)] += 3
    strength[: len(strength) // 5] *= seed % 2
    rate = int(fps * 512)
    _, want = librosa.beat.beat_track(onset_envelope=strength, sr=rate)
    monkeypatch.setattr(onsets, "_BLOCK", 300)
    np.testing.assert_array_equal(onsets.track_beats(strength, rate), want)


@pytest.mark.parametrize("fps", [5.0, 7.5, 60.0, 240.0])
def test_the_shortest_sound(fps: float) -> None:
    settings = AudioSettings(fps=fps)
    noise = np.random.default_rng(0).uniform(-1, 1, 6 * 512).astype(np.float32)
    for frames in range(3, 8):
        found = audio_features(noise[: (frames - 1) * 512], settings.rate, settings)
        assert found.shape == (frames, 438) and np.isfinite(found).all()


def test_mistakes_are_named() -> None:
    sound = np.zeros(30720, dtype=np.float32)
    with pytest.raises(UserError, match=r"0\.033 s"):
        audio_features(sound[:1023], 30720)
    assert audio_features(sound[:1024], 30720).shape == (3, 438)
    with pytest.raises(UserError, match="finite mono"):
        audio_features(np.full(30720, np.nan, dtype=np.float32), 30720)
    with pytest.raises(UserError, match="fps"):
        AudioSettings.parse({"fps": 29.97}, "settings")


def test_rows_belong_to_frames_and_every_beat_is_marked_once() -> None:
    clicks = (0.01 * np.random.default_rng(0).standard_normal(3 * 15360)).astype(np.float32)
    clicks.reshape(6, -1)[:, :200] += 0.5
    whole = audio_features(clicks, 15360, AudioSettings(fps=20))
    np.testing.assert_array_equal(features_of(Sound(clicks, 15360), 20), whole[:60])
    longer, quiet = rows_at(whole, 20, 20, 70), np.arange(438) != 53
    np.testing.assert_array_equal(longer[:61], whole)
    np.testing.assert_array_equal(longer[61:, quiet], np.repeat(whole[-1:, quiet], 9, axis=0))
    assert not longer[61:, 53].any()
    fast = audio_features(clicks, 15360)
    found = features_of(Sound(clicks, 15360), 20, rate=60)
    np.testing.assert_array_equal(found[:, quiet], fast[:-1:3, quiet])
    assert found[:, 53].sum() == fast[:, 53].sum() > 3
    seconds = np.flatnonzero(fast[:, 53]) / 60
    assert np.abs(np.flatnonzero(found[:, 53]) / 20 - seconds).max() <= 0.025 + 1e-9
    slow = rows_at(whole, 20, 60, 181)
    np.testing.assert_array_equal(slow[1::3, 0], whole[:60, 0])
    assert slow[:, 53].sum() == whole[:, 53].sum()
    assert settings_at(30).fps == 30
    assert settings_at(29.97).fps == settings_at(2).fps == settings_at(300).fps == 60


def test_nothing_is_compiled(tmp_path: Path) -> None:
    """Neither features nor beats touch what numba compiles of librosa: half a minute in a fresh cache."""
    code = """
import sys
import numpy as np
from motionloom.datasets.audio.features import audio_features, beats
from motionloom.datasets.audio.rhythm_features import rhythm_features
from motionloom.datasets.audio.sound import Sound
noise = np.random.default_rng(0).uniform(-1, 1, 30720).astype(np.float32)
audio_features(noise, 30720), beats(noise, 30720), rhythm_features(Sound(noise, 30720), 20.0, 20)
print("librosa.util.utils" in sys.modules, "librosa.core.audio" in sys.modules)
"""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-P", "-c", code], env=environment, capture_output=True, text=True)
    assert done.stdout.split() == ["False", "False"], done.stderr
    assert not list(tmp_path.rglob("*.nb?"))


# Beats are found in music and not in noise; decoding is the best path, by an obvious and slow version.

RATE = 16_000


def even_song(genre: str, bpm: int) -> Sound:
    song = Song(0, 1, genre, bpm, 3, 20.0)
    return Sound(render_song(song, RATE), RATE)


@pytest.mark.parametrize(("genre", "bpm"), [("house", 124), ("rock", 97)])
def test_beats_of_a_metronome_are_found_and_counted(genre: str, bpm: int) -> None:
    found = tracker.track(even_song(genre, bpm))
    truth = np.arange(0, 20, 60 / bpm)
    inside = (found.times > 1) & (found.times < 19)  # the ends have music on one side alone
    away = np.abs(found.times[inside, None] - truth).min(axis=1)
    assert away.max() < 0.03
    assert abs(inside.sum() - ((truth > 1) & (truth < 19)).sum()) <= 1
    assert found.meter == 4
    bars = found.times[(found.bar_places == 0) & inside]
    strong = truth[::4] if genre == "house" else truth[::2]  # rock's first and third beats are the same
    assert np.abs(bars[:, None] - strong).min(axis=1).max() < 0.03


def test_noise_and_silence_have_hardly_a_beat() -> None:
    samples = np.random.default_rng(0).standard_normal(10 * RATE).astype(np.float32)
    noise, silence = Sound(np.clip(0.2 * samples, -1, 1), RATE), Sound(np.zeros_like(samples), RATE)
    assert tracker.track(noise).pulse < tracker.NO_BEAT
    music = even_song("house", 124)
    assert tracker.track(silence).pulse < 0.1 and tracker.track(music).confidence > tracker.UNSURE
    assert not Prompt(sound=music.slice(3.0, 7.0)).remark and Prompt(sound=noise).remark
    assert Prompt(sound=silence).idle and not Prompt(sound=noise).idle
    assert Prompt("waves", sound=silence).remark and not Prompt("waves").remark
    assert not len(tracker.track(silence.slice(0.0, 1.0)).times)
    assert silence.silent and Sound(1e-4 * noise.samples, RATE).silent and not noise.silent
    quiet = Sound(0.01 * music.samples, RATE)  # gain moves no beat
    assert np.allclose(tracker.track(music).times, tracker.track(quiet).times, atol=0.01)


def test_the_path_of_beats_is_the_best_one(monkeypatch: pytest.MonkeyPatch) -> None:
    periods = np.array([3, 4, 5])
    monkeypatch.setattr(tracker, "PERIODS", periods)
    monkeypatch.setattr(tracker, "_MODERATE", 0.02)  # all three are unusual tempi
    heard = np.random.default_rng(3).random(17).astype(np.float32)
    kept = np.clip(heard, 0.02, 0.98).astype(np.float64)
    gain = np.log(kept / (1 - kept)) + tracker._EAGER
    change = tracker._change_cost(periods)

    def walk(first: int, steps: tuple[int, ...]) -> tuple[float, list[int]]:
        rows = first + np.cumsum(periods[list(steps)])[:-1]
        turns = sum(change[pair] for pair in pairwise(steps)) + change[steps[-1]].min()
        return float(gain[rows].sum() - turns), rows.tolist()

    # All ways from before the first row to beyond the last.
    walks = [
        walk(first, steps)
        for first in range(-5, 0)
        for count in range(4, 9)
        for steps in product(range(3), repeat=count)
        if first + periods[list(steps)].sum() >= len(heard) > first + periods[list(steps[:-1])].sum()
        and first + periods[steps[0]] >= 0
    ]
    assert tracker.beat_rows(heard).tolist() == max(walks)[1]


def test_bars_are_counted_by_three_and_go_on_after_a_cut() -> None:
    heard = np.tile([0.9, 0.05, 0.05], 12).astype(np.float32)
    places, meter = tracker.bar_places(np.concatenate([heard, heard[1:]]))
    assert meter == 3
    assert places.tolist() == [*[0, 1, 2] * 12, *([0, 1, 2] * 12)[1:]]


def test_blocks_of_a_long_piece_leave_no_seam(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    net = BeatNet(BeatNetConfig(width=8, layers=3)).eval()
    heard = np.random.default_rng(0).standard_normal((500, 64)).astype(np.float32)
    whole = activations(net, heard)
    monkeypatch.setattr("motionloom.datasets.audio.beat_net._BLOCK", 64)
    assert np.allclose(activations(net, heard), whole, atol=1e-6)


def test_files_that_hold_no_network_are_refused(tmp_path: Path) -> None:
    (tmp_path / "torn.safetensors").write_bytes(WEIGHTS.read_bytes()[:300])
    with pytest.raises(UserError, match=r"torn\.safetensors"):
        read_beat_net(tmp_path / "torn.safetensors")


def test_bands_hear_a_tone_where_it_is() -> None:
    t = np.arange(2 * RATE) / RATE
    power = band_power(Sound((0.5 * np.sin(2 * np.pi * 1000 * t)).astype(np.float32), RATE))
    assert power.shape == (2 * ROWS + 1, 64)
    assert abs(int(power[ROWS].argmax()) - band_from(1000.0)) <= 1
    assert np.abs(levels(power).mean(axis=0)).max() < 1e-4
