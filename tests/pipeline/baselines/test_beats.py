"""The stages that render songs and train the network of beats: loss falls, songs are kept, weights ship."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch

from motionloom.datasets.audio.beat_net import read_beat_net
from motionloom.pipeline.baselines.beats.songs import AnnotatedSong, SongsConfig
from motionloom.pipeline.baselines.beats.stage import put_into_package
from motionloom.pipeline.baselines.beats.training import SongBatches, _targets
from motionloom.pipeline.runs.api import run_recipe

RECIPE = """
name: beats
seed: 1
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  songs: {kind: songs, songs: 3, song_seconds: 12.0, played: false}
  beats:
    kind: beats
    net: {width: 12, layers: 4}
    window_seconds: 4.0
    train: {steps: 60, batch_size: 4, checkpoint_every: 30, validate_every: 30}
"""


def test_a_few_steps_lower_the_loss_and_the_weights_can_be_shipped(tmp_path: Path) -> None:
    (tmp_path / "beats.yaml").write_text(RECIPE)
    run_recipe(tmp_path / "beats.yaml", tmp_path / "run")
    stage = tmp_path / "run" / "stages" / "beats"
    rows = [json.loads(line) for line in (stage / "metrics.jsonl").read_text().splitlines()]
    losses = [row["train/loss"] for row in rows if "train/loss" in row]
    assert losses[-1] < 0.7 * losses[0]
    put_into_package(stage, tmp_path / "beats.safetensors")
    net = read_beat_net(tmp_path / "beats.safetensors")
    assert net(torch.zeros(1, 20, 64)).shape == (1, 20, 2)


def test_batches_repeat_and_their_targets_are_the_beats(tmp_path: Path) -> None:
    pool = SongsConfig(songs=2, song_seconds=12.0, played=False)
    songs = [AnnotatedSong.of(pool.song(number)) for number in range(2)]
    songs[0].save(tmp_path / "song.npz")
    songs[0] = AnnotatedSong.load(tmp_path / "song.npz")
    one, again = (SongBatches(songs, 300, 2, seed=5)[3] for _ in range(2))
    assert torch.equal(one["levels"], again["levels"]) and torch.equal(one["targets"], again["targets"])
    plain = SongBatches(songs, 300, 2, seed=5, augment=False)[0]["targets"].numpy()
    beats = sum(5.0 / pool.song(number).beat for number in range(2))  # in 300 rows of each
    assert abs(plain[..., 0].sum() / 2 - beats) <= 2  # each beat is 1 + 1/2 + 1/2
    assert (plain[..., 1] <= plain[..., 0] + 1e-6).all()  # a downbeat is a beat
    assert _targets(np.array([4.0, 9.5]), 12).tolist() == [0, 0, 0, 0.5, 1, 0.5, 0, 0, 0, 1, 1, 0]
