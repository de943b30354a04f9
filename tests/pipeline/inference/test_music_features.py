"""What a model hears of music: features of whole pieces, the same for a slice of one, heard once."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from motionloom.datasets.audio import features
from motionloom.datasets.audio.features import features_of
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.dances import DanceConfig
from motionloom.datasets.synth.music.recording import render_song
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.inference.requests import encode_prompts, prompts_of

pytestmark = pytest.mark.slow  # librosa compiles what it runs first

FPS, RATE = 20.0, 16_000
DANCER: Any = SimpleNamespace(modalities=frozenset({"audio"}), prepared={})


@pytest.fixture(scope="module")
def song() -> Sound:
    config = DanceConfig(songs=2, song_seconds=12.0)
    return Sound(render_song(config.song(0, 3), RATE), RATE)


def heard(sounds: list[Sound]) -> list[np.ndarray]:
    prompts = [Prompt(sound=sound) for sound in sounds]
    found = encode_prompts(DANCER, prompts, [""] * len(sounds), FPS, torch.device("cpu"))["audio"]
    return [f[m].numpy() for f, m in zip(found.features, found.mask, strict=True)]


def test_a_slice_is_heard_as_its_piece_is(song: Sound) -> None:
    whole = features_of(song, FPS)
    part = song.slice(4.0, 8.5)
    assert part.piece is song
    (found,) = heard([part])
    assert np.array_equal(found, whole[80:170])
    # Heard alone it would be another music: the tempogram alone spans many seconds.
    alone = features_of(Sound(part.samples, RATE), FPS)
    assert np.abs(alone - whole[80:170])[:, 54:].mean() > 0.01


def test_a_slice_of_a_slice_and_one_between_two_frames(song: Sound) -> None:
    inner = song.slice(2.0).slice(2.0, 6.5)
    assert inner.piece is song and inner.begin == 4.0
    assert np.array_equal(heard([inner])[0], heard([song.slice(4.0, 8.5)])[0])
    assert np.array_equal(heard([inner.resampled(8_000)])[0], heard([inner])[0])
    between = song.slice(4.02, 8.52)
    moved = song.slice(0.02)
    rows = features_of(Sound(moved.samples, RATE), FPS)
    assert np.array_equal(heard([between])[0], rows[80:170])


def test_pieces_are_heard_once(song: Sound, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    real = features.audio_features

    def counted(samples: np.ndarray, *rest: object) -> np.ndarray:
        calls.append(len(samples))
        return real(samples, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(features, "audio_features", counted)
    song = Sound(song.samples, song.rate)
    heard([song, song, song.slice(1.0, 3.0)])
    heard([song.slice(3.0, 5.0)])
    assert calls == [len(song.samples)]


def test_known_features_are_taken_as_they_are(song: Sound) -> None:
    rows = np.random.default_rng(0).normal(size=(30, 438)).astype(np.float32)
    prompts = prompts_of(None, None, [song, song], {"audio": [rows, None]})
    found = encode_prompts(DANCER, prompts, ["", ""], FPS, torch.device("cpu"))
    assert found["audio"].mask.sum(1).tolist() == [30, round(song.seconds * FPS)]
    assert np.array_equal(found["audio"].features[0, :30].numpy(), rows)
    with pytest.raises(UserError, match="2 sounds but 1 audio"):
        prompts_of(None, None, [song, song], {"audio": [rows]})
