"""Songs whose beat hides, and the network that learns from them: beats stay, bytes repeat, weights ship."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import mido
import numpy as np
import pytest
import torch

from motionloom.datasets.audio.beat_net import read_beat_net
from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.songs.band import DRUMS, band_version
from motionloom.pipeline.songs.scores import excerpt, scores
from motionloom.pipeline.songs.songs import AnnotatedSong, SongsConfig
from motionloom.pipeline.songs.stage import put_into_package
from motionloom.pipeline.songs.training import SongBatches, _targets

RECIPE = """
name: beats
seed: 1
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  songs: {kind: songs, songs: 3, song_seconds: 12.0}
  beats:
    kind: beats
    net: {width: 12, layers: 4}
    window_seconds: 4.0
    train: {steps: 60, batch_size: 4, checkpoint_every: 30, validate_every: 30}
"""


@pytest.fixture
def band() -> None:
    try:
        band_version()
    except UserError as error:
        pytest.skip(str(error))


@pytest.mark.slow
@pytest.mark.usefixtures("band")
def test_a_training_repeats_byte_for_byte_and_its_weights_can_be_shipped(tmp_path: Path) -> None:
    (tmp_path / "beats.yaml").write_text(RECIPE)
    shipped = []
    for name in ("one", "two"):
        run_recipe(tmp_path / "beats.yaml", tmp_path / name)
        stage = tmp_path / name / "stages" / "beats"
        put_into_package(stage, tmp_path / f"{name}.safetensors")
        shipped.append((tmp_path / f"{name}.safetensors").read_bytes())
    assert shipped[0] == shipped[1]
    rows = [json.loads(line) for line in (stage / "metrics.jsonl").read_text().splitlines()]
    losses = [row["train/loss"] for row in rows if "train/loss" in row]
    assert losses[-1] < 0.8 * losses[0]
    assert read_beat_net(tmp_path / "one.safetensors")(torch.zeros(1, 20, 64)).shape == (1, 20, 2)


def piece(path: Path, ticks: list[int], bpm: float, *meta: mido.MetaMessage, bars: int = 40) -> bytes:
    """A MIDI file of 96 ticks a quarter with a snare at these ticks of every 384, or 1,152."""
    track = mido.MidiTrack([mido.MetaMessage("set_tempo", tempo=mido.bpm2tempo(bpm)), *meta])
    now = 0
    for at in ((384 if ticks[-1] < 384 else 1152) * bar + tick for bar in range(bars) for tick in ticks):
        track.append(mido.Message("note_on", channel=DRUMS, note=38, velocity=110, time=at - now))
        track.append(mido.Message("note_off", channel=DRUMS, note=38, time=6))
        now = at + 6
    file = mido.MidiFile(ticks_per_beat=96)
    file.tracks.append(track)
    file.save(path)
    return path.read_bytes()


WALTZ = mido.MetaMessage("time_signature", numerator=6, denominator=8)


@pytest.mark.parametrize(
    ("ticks", "bpm", "meta", "step"),
    [([0, 96, 192, 288], 120, (), 0.5), ([0, 192], 240, (), 0.5), ([0, 96, 192, 288], 40, (), 0.75),
     ([0, 144, 288, 432, 576, 720, 864, 1008], 120, (WALTZ,), 0.75), ([48, 144, 240, 336], 120, (), None)],
)  # fmt: skip
def test_scores_count_their_beats_or_are_left_out(
    tmp_path: Path, ticks: list[int], bpm: float, meta: tuple[mido.MetaMessage, ...], step: float | None
) -> None:
    data = piece(tmp_path / "piece.mid", ticks, bpm, *meta)
    if step is None:
        with pytest.raises(UserError, match="no MIDI file"):
            scores((tmp_path,))
        return
    # The same piece in a WAD, twice under two names, is one.
    head = struct.pack("<4sii", b"PWAD", 2, 12 + len(data))
    names = b"".join(struct.pack("<ii8s", 12, len(data), name) for name in (b"D_ONE", b"D_TWO"))
    (tmp_path / "music.wad").write_bytes(head + data + names)
    found = scores((tmp_path / "music.wad", tmp_path / "piece.mid"))
    assert len(found) == 2 and np.diff(found[0].beats) == pytest.approx(step)
    part = excerpt(found[0], 8.0, np.random.default_rng(1))
    beats = np.array([note.at for note in part.notes])
    assert np.ptp(np.diff(part.beats)) < 1e-6 and beats.min() >= 0.0 and beats.max() < 8.0
    with pytest.raises(UserError, match=r"songs\.scores"):
        scores((tmp_path / "nowhere",))


def test_drums_are_struck_between_the_beats_too() -> None:
    arranged = [SongsConfig(songs=12, song_seconds=20.0).arranged(number) for number in range(12)]
    drums = [np.array([note.channel == DRUMS for note in one.notes]) for one in arranged]
    places = np.concatenate([one.numbers()[struck] for one, struck in zip(arranged, drums, strict=True)])
    assert np.mean(np.abs(places - np.round(places)) > 0.1) > 0.3
    assert min(note.at for one in arranged for note in one.notes) >= 0.0


@pytest.mark.usefixtures("band")
def test_batches_repeat_and_their_targets_are_the_beats(tmp_path: Path) -> None:
    pool = SongsConfig(songs=2, song_seconds=12.0)
    songs = [AnnotatedSong.of(pool.arranged(number), 12.0, [number]) for number in range(2)]
    songs[0].save(tmp_path / "song.npz")
    songs[0] = AnnotatedSong.load(tmp_path / "song.npz")
    one, again = (SongBatches(songs, 300, 2, seed=5)[3] for _ in range(2))
    assert torch.equal(one["levels"], again["levels"]) and torch.equal(one["targets"], again["targets"])
    plain = SongBatches(songs, 600, 2, seed=5, augment=False)[0]["targets"].numpy()
    beats = sum(10.0 / np.diff(song.beats).mean() for song in songs)
    assert abs((plain[..., 0] > 0.99).sum() - beats) <= 0.5 * beats  # a beat between two rows is in both
    assert ((plain[..., 1] <= plain[..., 0] + 1e-6) | (plain[..., 1] == 0)).all()  # a downbeat is a beat
    assert _targets(np.array([4.0, 9.5]), 12).tolist() == [0, 0, 0, 0.5, 1, 0.5, 0, 0, 0, 1, 1, 0]
