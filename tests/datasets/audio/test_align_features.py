"""Audio features aligned with the frames of a motion."""

from __future__ import annotations

import numpy as np
import pytest

from motionloom.datasets.audio.align_features import motion_frame_features, rows_at, settings_at
from motionloom.datasets.audio.features import AudioSettings, audio_features
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.schema import UserError

RATE = 15360


@pytest.fixture(scope="module")
def clicks() -> np.ndarray:
    """Three seconds with a click every half second."""
    out = (0.01 * np.random.default_rng(0).standard_normal(3 * RATE)).astype(np.float32)
    out.reshape(6, -1)[:, :200] += 0.5
    return out


@pytest.fixture(scope="module")
def sound(clicks: np.ndarray) -> Sound:
    return Sound(clicks, RATE)


def test_frames_are_cut_and_padded(clicks: np.ndarray, sound: Sound) -> None:
    whole = audio_features(clicks, RATE, AudioSettings(fps=20))
    assert len(whole) == 61
    cut = motion_frame_features(sound, 20, 40)
    assert cut.dtype == np.float32
    np.testing.assert_array_equal(cut, whole[:40])
    longer = motion_frame_features(sound, 20, 70)
    np.testing.assert_array_equal(longer[:61], whole)
    quiet = np.arange(438) != 53
    np.testing.assert_array_equal(longer[61:, quiet], np.repeat(whole[-1:, quiet], 9, axis=0))
    assert not longer[61:, 53].any()
    with pytest.raises(UserError, match="0 frames at 20"):
        motion_frame_features(sound, 20, 0)


def test_rows_nearest_in_time_and_every_beat_once(clicks: np.ndarray, sound: Sound) -> None:
    fast = AudioSettings(fps=60)
    whole = audio_features(clicks, RATE, fast)
    found = motion_frame_features(sound, 20, 61, fast)
    quiet = np.arange(438) != 53
    np.testing.assert_array_equal(found[:, quiet], whole[::3, quiet])
    assert found[:, 53].sum() == whole[:, 53].sum() > 3
    seconds = np.flatnonzero(whole[:, 53]) / 60
    assert np.abs(np.flatnonzero(found[:, 53]) / 20 - seconds).max() <= 0.025 + 1e-9
    slow = rows_at(whole[::3], 20, 60, 181)
    np.testing.assert_array_equal(slow[1::3, 0], whole[::3, 0][: len(slow[1::3])])
    assert slow[:, 53].sum() == whole[::3, 53].sum()


def test_frame_rates_that_features_cannot_have(clicks: np.ndarray, sound: Sound) -> None:
    assert settings_at(30).fps == 30
    assert settings_at(29.97).fps == settings_at(2).fps == settings_at(300).fps == 60
    found = motion_frame_features(sound, 29.97, 90)
    whole = audio_features(clicks, RATE)
    np.testing.assert_array_equal(found[89, :53], whole[round(89 / 29.97 * 60), :53])
