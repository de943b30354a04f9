"""Beats are found in music and not in noise; decoding is the best path, by an obvious and slow version."""

from __future__ import annotations

from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
import torch

from motionloom.datasets.audio import tracker
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
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.music.recording import render_song
from motionloom.datasets.synth.music.song import Song
from motionloom.pipeline.contract.generation import Prompt

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
    assert tracker.track(noise).confidence < tracker.NO_BEAT
    music = even_song("house", 124)
    assert tracker.track(silence).confidence < 0.1 and tracker.track(music).confidence > 0.5
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
