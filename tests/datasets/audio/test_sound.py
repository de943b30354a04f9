"""Reading sound: every common encoding, and no broken file passes for music."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import soundfile

from motionloom.datasets.audio.sound import read_sound, resample_sound, sound_seconds
from motionloom.datasets.schema import UserError

RATE = 16_000


@pytest.fixture(scope="module")
def tone() -> np.ndarray:
    return (0.5 * np.sin(2 * np.pi * 220 * np.arange(RATE) / RATE)).astype(np.float32)


@pytest.mark.parametrize(
    ("name", "subtype", "error"),
    [
        ("a.wav", "PCM_U8", 2**-7),
        ("a.wav", "PCM_16", 2**-15),
        ("a.wav", "PCM_24", 2**-23),
        ("a.wav", "PCM_32", 1e-7),
        ("a.wav", "FLOAT", 0.0),
        ("a.wav", "DOUBLE", 0.0),
        ("a.flac", "PCM_16", 2**-15),
        ("a.ogg", "VORBIS", 0.05),
        ("a.mp3", "MPEG_LAYER_III", 0.05),
    ],
)
def test_every_encoding_gives_the_same_sound(
    tmp_path: Path, tone: np.ndarray, name: str, subtype: str, error: float
) -> None:
    path = tmp_path / name
    soundfile.write(path, tone, RATE, subtype=subtype)
    samples, rate = read_sound(path)
    assert rate == RATE
    assert samples.dtype == np.float32
    assert samples.shape == tone.shape
    assert np.abs(samples).max() <= 1
    assert np.abs(samples - tone).max() <= error
    assert sound_seconds(path) == pytest.approx(1.0)


def test_rf64_and_extensible_headers(tmp_path: Path, tone: np.ndarray) -> None:
    for kind in ("RF64", "WAVEX"):
        path = tmp_path / "a.wav"
        soundfile.write(path, tone, RATE, format=kind, subtype="PCM_24")
        assert np.abs(read_sound(path)[0] - tone).max() < 1e-6


def test_stereo_becomes_the_mean(tmp_path: Path, tone: np.ndarray) -> None:
    path = tmp_path / "a.wav"
    soundfile.write(path, np.stack([tone, 0.5 * tone], axis=1), RATE, subtype="FLOAT")
    assert np.allclose(read_sound(path)[0], 0.75 * tone, atol=1e-7)


def test_overshoot_is_clipped_and_another_unit_refused(tmp_path: Path, tone: np.ndarray) -> None:
    path = tmp_path / "a.wav"
    soundfile.write(path, 3 * tone, RATE, subtype="FLOAT")
    assert np.abs(read_sound(path)[0]).max() == 1.0
    soundfile.write(path, 32767 * tone, RATE, subtype="FLOAT")
    with pytest.raises(UserError, match=r"a\.wav: samples reach"):
        read_sound(path)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("zero_samples.wav", "0 samples"),
        ("truncated.wav", "1600 bytes of sound, 16000 expected"),
        ("sample_rate_zero.wav", "sample rate 0"),
        ("not_riff.wav", "not a WAV file"),
        ("float_nan.wav", "NaN or infinity at sample 2"),
    ],
)
def test_broken_wavs(shared: Path, name: str, reason: str) -> None:
    with pytest.raises(UserError, match=f"{name}: .*{reason}"):
        read_sound(shared / "data/broken/wav" / name)


def test_music_of_the_dance_fixture(shared: Path) -> None:
    folder = shared / "data/layouts/aistpp/wavs"
    for name, rate, count in (
        ("mBR0", 8000, 96000),  # a LIST chunk lies before the samples
        ("mHO9", 8000, 24000),  # IEEE float, format tag 3
        ("synthetic_stereo24", 22050, 5512),
    ):
        samples, found = read_sound(folder / f"{name}.wav")
        assert (found, samples.shape) == (rate, (count,))
        assert 0 < np.abs(samples).max() <= 1


def test_damage_anywhere_in_a_wav_is_told(tmp_path: Path, tone: np.ndarray) -> None:
    whole = tmp_path / "whole.wav"
    soundfile.write(whole, tone[:200], RATE, subtype="FLOAT")
    raw = whole.read_bytes()
    path = tmp_path / "cut.wav"
    for size in range(len(raw)):
        path.write_bytes(raw[:size])
        with pytest.raises(UserError, match=r"cut\.wav: "):
            read_sound(path)


def test_damaged_flac_and_unknown_files(tmp_path: Path, tone: np.ndarray) -> None:
    path = tmp_path / "a.flac"
    soundfile.write(path, tone, RATE)
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(UserError, match=r"a\.flac: "):
        read_sound(path)
    path.write_bytes(b"not sound at all")
    for read in (read_sound, sound_seconds):
        with pytest.raises(UserError, match=r"a\.flac: not readable sound"):
            read(path)
    with pytest.raises(UserError, match="no such file"):
        read_sound(tmp_path / "absent.wav")


def test_a_header_that_promises_more_than_can_be_read(tmp_path: Path, tone: np.ndarray) -> None:
    path = tmp_path / "a.wav"
    soundfile.write(path, tone, RATE, subtype="PCM_16")
    raw = bytearray(path.read_bytes())
    raw[40:44] = struct.pack("<I", 0xFFFFFFF0)
    path.write_bytes(raw)
    with pytest.raises(UserError, match="32000 bytes of sound, 4294967280 expected"):
        read_sound(path)


@pytest.mark.parametrize(
    ("rate_in", "rate_out"), [(8000, 30720), (16000, 8000), (22050, 30720), (44100, 16000)]
)
def test_resampling_equals_librosa(rate_in: int, rate_out: int) -> None:
    import librosa

    rng = np.random.default_rng(0)
    for size in (1, 10, 4001):
        sound = rng.uniform(-1, 1, size).astype(np.float32)
        wanted = librosa.resample(sound, orig_sr=rate_in, target_sr=rate_out, res_type="soxr_hq")
        assert np.array_equal(resample_sound(sound, rate_in, rate_out), wanted)


def test_resampling_equals_the_golden_vectors(shared: Path) -> None:
    with np.load(shared / "golden/t5_audio_A.npz", allow_pickle=False) as golden:
        track = golden["syn_wav"].astype(np.float32) / 32768
        for rate in (3840, 15360):
            out = resample_sound(track, 30720, rate)
            assert out.dtype == np.float32
            assert np.abs(out - golden[f"syn_wav_{rate}"]).max() < 1e-6
    assert resample_sound(track, 30720, 30720) is track
    with pytest.raises(UserError, match="positive"):
        resample_sound(track, 0, 16000)
