"""Reading sound: every common encoding, and no broken file passes for music."""

from __future__ import annotations

import os
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from motionloom.datasets.audio import sound
from motionloom.datasets.audio.mp3 import unheard
from motionloom.datasets.audio.sound import Sound, read_sound, resample_sound, sound_seconds
from motionloom.datasets.base.errors import UserError

RATE = 16_000


@pytest.fixture(scope="module")
def tone() -> np.ndarray:
    return (0.5 * np.sin(2 * np.pi * 220 * np.arange(RATE) / RATE)).astype(np.float32)


def test_what_libsndfile_reads_is_read_whatever_its_suffix(tmp_path: Path, tone: np.ndarray) -> None:
    stereo, suffixes = np.stack([tone, 0.5 * tone], axis=1), (".wav", ".mp3", ".flac", ".dat")
    for form in soundfile.available_formats():
        for number, subtype in enumerate(soundfile.available_subtypes(form)):
            path = tmp_path / f"a{suffixes[number % 4]}"
            try:
                soundfile.write(path, stereo, RATE, format=form, subtype=subtype)
                expected, rate = soundfile.read(path, dtype="float32", always_2d=True)
            except (soundfile.SoundFileError, ValueError):  # a kind that libsndfile cannot write so
                continue
            samples, own_rate = read_sound(path)
            assert (own_rate, len(samples), samples.dtype) == (rate, len(expected), np.float32), (
                form,
                subtype,
            )
            assert sound_seconds(path) == len(samples) / rate
            assert np.abs(samples - expected.mean(axis=1).clip(-1, 1)).max() < 1e-5, (form, subtype)


def test_what_stands_around_the_samples_changes_none(tmp_path: Path, tone: np.ndarray) -> None:
    song, tagged = tmp_path / "song.mp3", tmp_path / "cover.mp3"
    soundfile.write(song, tone, RATE)
    for picture in (0, 40_000, 90_000, 3_000_000):
        length = bytes(picture >> 7 * (3 - i) & 127 for i in range(4))
        tagged.write_bytes(b"ID3\x03\0\0" + length + bytes(picture) + song.read_bytes())
        assert np.array_equal(read_sound(tagged)[0], read_sound(song)[0])
    whole, piped = tmp_path / "whole.wav", tmp_path / "piped.wav"
    soundfile.write(whole, tone, RATE)
    raw = whole.read_bytes()
    at = raw.index(b"data") + 4
    for length in (0xFFFFFFFF, 0xFFFFFFFF - 36, 0x7FFFFFFF, 0x7FFFF000):
        piped.write_bytes(raw[:at] + length.to_bytes(4, "little") + raw[at + 4 :])
        assert np.array_equal(read_sound(piped)[0], read_sound(whole)[0])


def test_stereo_is_averaged_overshoot_clipped_and_another_unit_refused(
    tmp_path: Path, tone: np.ndarray
) -> None:
    path = tmp_path / "a.wav"
    soundfile.write(path, np.stack([tone, 0.5 * tone], axis=1), RATE, subtype="FLOAT")
    assert np.allclose(read_sound(path)[0], 0.75 * tone, atol=1e-7)
    soundfile.write(path, 3 * tone, RATE, subtype="FLOAT")
    assert np.abs(read_sound(path)[0]).max() == 1.0
    soundfile.write(path, 32767 * tone, RATE, subtype="FLOAT")
    with pytest.raises(UserError, match=r"a\.wav: samples reach"):
        read_sound(path)


def test_damage_anywhere_in_a_wav_is_told(tmp_path: Path, tone: np.ndarray) -> None:
    whole = tmp_path / "whole.wav"
    soundfile.write(whole, tone[:200], RATE, subtype="FLOAT")
    raw = whole.read_bytes()
    path = tmp_path / "cut.wav"
    for size in range(len(raw)):
        path.write_bytes(raw[:size])
        with pytest.raises(UserError, match=r"cut\.wav: "):
            read_sound(path)


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


@pytest.mark.parametrize("rates", [(48000, 30720), (44100, 48000), (8000, 3840)])
def test_reading_at_another_rate_equals_resampling(
    tmp_path: Path, rates: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, (own, wanted) = tmp_path / "a.wav", rates
    for count in (1, 3000, 40001):
        noise = np.random.default_rng(count).uniform(-0.9, 0.9, (count, 2)).astype(np.float32)
        soundfile.write(path, noise, own, subtype="FLOAT")
        samples, rate = read_sound(path)
        monkeypatch.setattr(sound, "_BLOCK", 4096)
        found, at = read_sound(path, rate=wanted)
        assert (rate, at) == (own, wanted)
        np.testing.assert_array_equal(found, resample_sound(samples, own, wanted))


def test_memory_follows_the_mono_samples(tmp_path: Path) -> None:
    """A minute of 48 kHz in eight channels: 92 MB as float32, 11.5 MB in mono."""
    path = tmp_path / "a.flac"
    with soundfile.SoundFile(path, "w", 48000, 8) as file:
        for _ in range(60):
            file.write(np.zeros((48000, 8), dtype=np.float32))
    read_sound(path, rate=30720)  # imports
    tracemalloc.start()
    try:
        samples, _ = read_sound(path, rate=30720)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(samples) == 60 * 30720
    assert peak < 2 * samples.nbytes + 2 * 2**18 * 8 * 4 + 2**22


def test_sound_of_a_file(tmp_path: Path, tone: np.ndarray) -> None:
    path = tmp_path / "a.wav"
    soundfile.write(path, tone, RATE, subtype="FLOAT")
    whole = Sound.read(path)
    assert (whole.rate, whole.seconds) == (RATE, 1.0)
    np.testing.assert_array_equal(whole.samples, tone)
    np.testing.assert_array_equal(whole.slice(0.25, 0.5).samples, tone[4000:8000])
    np.testing.assert_array_equal(whole.slice(0.9, 5).samples, tone[14400:])
    np.testing.assert_array_equal(whole.slice(-1).samples, tone)
    with pytest.raises(UserError, match=r"second 2 .* 1\.000"):
        whole.slice(2)
    with pytest.raises(UserError, match=r"second 0\.5 and 0\.5"):
        whole.slice(0.5, 0.5)
    half = whole.resampled(8000)
    np.testing.assert_array_equal(half.samples, Sound.read(path, 8000).samples)
    assert (half.rate, half.seconds) == (8000, 1.0)


@pytest.mark.parametrize(
    ("samples", "rate", "reason"),
    [
        (np.zeros((2, 5)), 100, "not of shape"),
        (np.array([0, np.nan]), 100, "finite"),
        (np.array([0, -1.5]), 100, "reaches 1.5"),
        (np.zeros(5), 0, "positive"),
    ],
)
def test_what_is_no_sound(samples: np.ndarray, rate: int, reason: str) -> None:
    with pytest.raises(UserError, match=reason):
        Sound(samples, rate)


def mp3(path: Path, samples: np.ndarray, rate: int = 44100, **how: Any) -> bytes:
    soundfile.write(path, samples, rate, **how)
    return path.read_bytes()


ID3 = b"ID3\x04\0\0\0\0\x10\0" + bytes(2048)


@pytest.mark.parametrize("mode", ["CONSTANT", "VARIABLE"])
@pytest.mark.parametrize("stated", [True, False])
def test_no_sound_of_an_mp3_is_lost_or_added(
    tmp_path: Path, tone: np.ndarray, mode: str, *, stated: bool
) -> None:
    """Quiet, then loud: a guess of the length from the size and the first frame is four times too short."""
    path, noise = tmp_path / "a.mp3", np.random.default_rng(0).uniform(-0.5, 0.5, 5 * RATE)
    sound = np.concatenate([np.tile(tone, 5), noise.astype(np.float32)])
    raw = mp3(path, sound, bitrate_mode=mode, compression_level=0.3)
    if not stated:
        raw = raw[raw.index(raw[:2], 10) :]  # the encoder states the length in the first frame
    for whole in (raw, ID3 + raw, raw + b"TAG" + bytes(125)):
        path.write_bytes(whole)
        samples, _ = read_sound(path)
        assert 0 <= len(samples) - len(sound) < (1 if stated else 4 * 1152)
        assert np.abs(samples[-4 * 1152 - 500 : -4 * 1152]).max() > 0.2
        assert sound_seconds(path) == len(samples) / 44100
        half = read_sound(path, rate=22050)[0]
        assert len(half) == -(-len(samples) // 2)
    for cut in (raw[: len(raw) // 2 + 10], (ID3 + raw)[: -len(raw) // 3]):  # in the midst of a frame
        path.write_bytes(cut)
        with pytest.raises(UserError, match=r"a\.mp3: .*cut short"):
            read_sound(path)


@pytest.mark.parametrize(("missing", "read"), [(100, True), (RATE, False)])
def test_a_whole_file_may_lack_its_last_block(
    tmp_path: Path, tone: np.ndarray, monkeypatch: pytest.MonkeyPatch, missing: int, read: bool
) -> None:
    path = tmp_path / "a.ogg"
    soundfile.write(path, tone, RATE)
    samples = read_sound(path)[0]
    monkeypatch.setattr("motionloom.datasets.audio.sound._length", lambda *_: (len(samples) + missing, RATE))
    if read:
        longer = read_sound(path)[0]
        assert np.array_equal(longer[: len(samples)], samples) and not longer[len(samples) :].any()
        assert len(longer) == len(samples) + missing
    else:
        with pytest.raises(UserError, match=r"a\.ogg: cut short"):
            read_sound(path)


def test_damaged_files_of_every_kind(
    tmp_path: Path, tone: np.ndarray, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.mp3"
    raw = mp3(path, np.tile(tone, 5))
    half = len(raw) // 2
    for damaged, reason in (
        (raw[:-1], r"cut short: 1 bytes"),
        (raw[:half] + bytes(4000) + raw[half + 4000 :], "not readable sound .damaged"),
        (raw[:200], "cut short"),
        (b"not sound at all" * 100, "not readable sound .of no known format"),
        (b"", "empty file"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(UserError, match=rf"a\.mp3: {reason}"):
            read_sound(path)
    with unheard():
        os.write(2, b"Note: of libmpg123\nours\n")
    assert capfd.readouterr().err == "ours\n", "decoders speak to nobody"
    for name in ("a.ogg", "a.flac"):
        path = tmp_path / name
        soundfile.write(path, np.tile(tone, 5), RATE)
        path.write_bytes(path.read_bytes()[:-2000])
        with pytest.raises(UserError, match=f"{name}: "):
            read_sound(path)
    path.write_bytes(b"not sound at all")
    for read in (read_sound, sound_seconds):
        with pytest.raises(UserError, match=r"a\.flac: "):
            read(path)
    with pytest.raises(UserError, match="no such file"):
        read_sound(tmp_path / "absent.wav")


# Parts of sound files by name.


@pytest.fixture
def song(tmp_path: Path) -> Path:
    """100 s whose samples say where they are."""
    path = tmp_path / "song.flac"
    soundfile.write(path, np.arange(100 * 8000) / (100 * 8000), 8000, subtype="PCM_24")
    return path


@pytest.mark.parametrize(
    ("part", "start", "end"),
    [
        ("0:30-1:00", 30, 60),
        ("45-", 45, 100),
        ("-1:20", 0, 80),
        ("1.5-2.25", 1.5, 2.25),
        ("0:00:10-0:01:00.5", 10, 60.5),
        ("90-100.4", 90, 100),
    ],
)
def test_start_and_end(song: Path, part: str, start: float, end: float) -> None:
    sound = Sound.read(f"{song}@{part}")
    assert sound.seconds == pytest.approx(end - start)
    assert sound.samples[0] * 100 == pytest.approx(start, abs=1e-3)
    assert sound.piece is not None and sound.piece.seconds == 100, "features are those of the whole piece"


@pytest.mark.parametrize(
    ("part", "fix"),
    [
        ("60-30", "swap them"),
        ("0.10-0.20", "did you mean song.flac@0:10-0:20"),
        ("1:75-", "m:ss"),
        ("1.2.3-", "m:ss"),
        ("30", "0:30-1:00"),
        ("-", "0:30-1:00"),
        ("200-", "100.0 s long"),
        ("20-200", "100.0 s long"),
    ],
)
def test_mistakes_name_the_file_and_the_fix(song: Path, part: str, fix: str) -> None:
    with pytest.raises(UserError, match=fix) as caught:
        Sound.read(f"{song}@{part}")
    assert f"song.flac@{part}" in str(caught.value)


def test_a_file_with_that_very_name_is_taken_whole(song: Path) -> None:
    named = song.rename(song.parent / "me@0:10-0:20")
    assert Sound.read(named).seconds == 100
    assert Sound.read(f"{named}@10-30").seconds == 20


def test_what_is_not_read_says_how_to_convert_it(tmp_path: Path) -> None:
    path = tmp_path / "song.m4a"
    path.write_bytes(b"\0\0\0\x1cftypM4A \0\0\2\0" + bytes(4000))
    with pytest.raises(UserError, match=r"song\.m4a: .*ffmpeg"):
        Sound.read(path)
