"""The cache of audio features: computed once, by content and settings, whoever asks."""

from __future__ import annotations

import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile

from motionloom.datasets.audio import cache as cache_module
from motionloom.datasets.audio.cache import AudioCache
from motionloom.datasets.audio.features import AudioSettings, audio_features
from motionloom.datasets.schema import UserError


@pytest.fixture
def music(tmp_path: Path) -> Path:
    time_axis = np.arange(15360) / 15360
    soundfile.write(tmp_path / "music.wav", 0.3 * np.sin(2 * np.pi * 330 * time_axis), 15360)
    return tmp_path / "music.wav"


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one with every computation."""
    calls: list[int] = []

    def counted(*args: object) -> np.ndarray:
        calls.append(1)
        return audio_features(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(cache_module, "audio_features", counted)
    return calls


def test_each_content_and_settings_once(music: Path, tmp_path: Path, computed: list[int]) -> None:
    store = AudioCache(tmp_path / "cache", AudioSettings(fps=30))
    first = store.features(music)
    assert first.dtype == np.float32 and first.shape == (31, 438)
    again = pickle.loads(pickle.dumps(store)).features(shutil.copy(music, tmp_path / "other_name.wav"))
    np.testing.assert_array_equal(first, again)
    assert len(computed) == 1
    assert AudioCache(tmp_path / "cache", AudioSettings(fps=20)).features(music).shape == (21, 438)
    assert len(computed) == 2
    soundfile.write(music, np.zeros(15360), 15360)
    assert not np.array_equal(store.features(music), first)
    assert len(computed) == 3


def test_damaged_files_are_made_again(music: Path, tmp_path: Path, computed: list[int]) -> None:
    store = AudioCache(tmp_path / "cache", AudioSettings(fps=30))
    first = store.features(music)
    (path,) = (tmp_path / "cache").glob("*/*.npy")
    for damage in (path.read_bytes()[:-5], b"", b"not an array"):
        path.write_bytes(damage)
        np.testing.assert_array_equal(store.features(music), first)
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    np.testing.assert_array_equal(store.features(music), first)
    assert len(computed) == 5


def test_broken_sound_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "bad.wav").write_bytes(b"RIFF")
    store = AudioCache(tmp_path / "cache")
    for name in ("bad.wav", "missing.wav"):
        with pytest.raises(UserError, match=name):
            store.features(tmp_path / name)
    assert not (tmp_path / "cache").exists()


SLOW = """
import sys, time
from pathlib import Path
from motionloom.datasets.audio import cache
from motionloom.datasets.audio.features import AudioSettings
real = cache.audio_features
def slow(*args):
    print("computing", flush=True)
    time.sleep(float(sys.argv[3]))
    return real(*args)
cache.audio_features = slow
cache.AudioCache(sys.argv[2], AudioSettings(fps=30)).features(Path(sys.argv[1]))
"""


def start(music: Path, folder: Path, seconds: float) -> subprocess.Popen:
    command = [sys.executable, "-P", "-c", SLOW, str(music), str(folder), str(seconds)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def test_others_wait_for_the_one_that_computes_and_not_for_a_killed_one(music: Path, tmp_path: Path) -> None:
    killed = start(music, tmp_path / "cache", 60)
    assert killed.stdout is not None and killed.stdout.readline() == "computing\n"
    killed.kill()
    killed.communicate()
    both = [start(music, tmp_path / "cache", 1) for _ in range(2)]
    said = [process.communicate(timeout=60)[0] for process in both]
    assert sorted(said) == ["", "computing\n"]
    assert [process.returncode for process in both] == [0, 0]


def test_several_sounds_in_processes(music: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.wav"
    soundfile.write(other, np.random.default_rng(0).uniform(-0.5, 0.5, 7680), 15360)
    store = AudioCache(tmp_path / "cache", AudioSettings(fps=30))
    found = store.all_features([other, music, other], workers=2)
    assert [len(features) for features in found] == [16, 31, 16]
    for path, features in zip((other, music), found, strict=False):
        np.testing.assert_array_equal(features, AudioCache(tmp_path / "again", store.settings).features(path))


def test_a_sound_that_is_too_short_is_named(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "short.wav", np.zeros(100), 15360)
    with pytest.raises(UserError, match=r"short\.wav: sound of 0\.007 s is too short"):
        AudioCache(tmp_path / "cache").features(tmp_path / "short.wav")
