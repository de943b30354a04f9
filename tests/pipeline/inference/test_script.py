"""Driving scripts: their forms and mistakes, sound files of all kinds, the sound of a whole motion."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.inference.script import DrivenSegment, Script, ScriptSegment, read_music, sound_of
from motionloom.pipeline.runs.generation import generate_motions

Write = Callable[..., Path]


def tune(seconds: float, rate: int = 16_000, hertz: float = 440.0) -> np.ndarray:
    t = np.arange(round(seconds * rate)) / rate
    return (0.5 * np.sin(2 * np.pi * hertz * t)).astype(np.float32)


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """`write(text) -> show.yaml` beside song.wav of 6 s."""
    soundfile.write(tmp_path / "song.wav", tune(6.0), 16_000)

    def go(text: str) -> Path:
        path = tmp_path / "show.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return go


def opened(path: Path) -> list[DrivenSegment]:
    return Script.read(path).open(path.parent, str(path))


# ---- forms


def test_all_forms_of_a_segment(write: Write) -> None:
    path = write("""
segments:
  - {text: a person walks, seconds: 4}
  - text: a person bows
    face: a person smiles
    seconds: 1.5
  - {music: song.wav}
  - {music: song.wav, start: 2}
  - {music: song.wav, end: 3}
  - {music: song.wav, start: 1, seconds: 2.5}
  - {music: song.wav, start: 1, end: 5.25, text: a person spins}
""")
    found = opened(path)
    assert [s.seconds for s in found] == pytest.approx([4, 1.5, 6, 4, 3, 2.5, 4.25])
    assert [s.label for s in found] == [
        "a person walks", "a person bows", "song", "song", "song", "song", "a person spins + song",
    ]  # fmt: skip
    assert found[1].prompt.face_text == found[1].prompt.words == "a person smiles"
    assert [s.prompt.sound is None for s in found] == [True, True, *[False] * 5]
    whole = Sound.read(path.parent / "song.wav").samples
    for segment, (first, last) in zip(found[2:], [(0, 6), (2, 6), (0, 3), (1, 3.5), (1, 5.25)], strict=True):
        sound = segment.prompt.sound
        assert sound is not None and sound.rate == 16_000
        assert np.array_equal(sound.samples, whole[round(first * 16_000) : round(last * 16_000)])
    assert found[6].prompt.modalities == {"text", "audio"}


def test_a_file_is_read_once(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Any] = []
    before = Sound.read.__func__  # type: ignore[attr-defined]
    monkeypatch.setattr(Sound, "read", classmethod(lambda cls, p: (read.append(p), before(cls, p))[1]))
    opened(write("segments: [{music: song.wav, end: 2}, {music: song.wav, start: 3}]"))
    assert len(read) == 1


def test_an_end_just_behind_the_music_is_its_end(write: Write) -> None:
    (segment,) = opened(write("segments: [{music: song.wav, start: 4, end: 6.4}]"))
    assert segment.seconds == pytest.approx(2.0)


def test_a_script_from_python(tmp_path: Path) -> None:
    script = Script(segments=[ScriptSegment(text="a person walks", seconds=2)])
    (segment,) = script.open(tmp_path)
    assert segment == DrivenSegment(Prompt("a person walks", ""), 2.0, "a person walks")


# ---- mistakes


MISTAKES = {
    "segments: []": "segments",
    "{}": "segments",
    "": "segments",
    "- {text: a, seconds: 1}": "a script is a mapping with a list 'segments'",
    "segments: 3": "segments",
    "segments: [{text: a person walks, second: 3}]": r"segments\.0\.second'; did you mean 'seconds'",
    "segments: [{text: a person walks}]": r"segments\.0.*a segment of text needs its length: seconds: 4",
    "segments: [{seconds: 3}]": r"segments\.0.*a segment needs text, music or both",
    "segments: [{text: '  ', seconds: 3}]": r"segments\.0.*a segment needs text, music or both",
    "segments: [{text: a, seconds: 0}]": r"segments\.0\.seconds",
    "segments: [{text: a, seconds: -1}]": r"segments\.0\.seconds",
    "segments: [{text: a, seconds: .inf}]": r"segments\.0\.seconds",
    "segments: [{text: a, seconds: .nan}]": r"segments\.0\.seconds",
    "segments: [{text: a, seconds: soon}]": r"segments\.0\.seconds",
    "segments: [{text: a, seconds: 2, start: 1}]": r"segments\.0.*start and end are seconds of the music",
    "segments: [{text: a, seconds: 2, end: 1}]": r"segments\.0.*start and end are seconds of the music",
    "segments: [{music: song.wav, start: 3, end: 2}]": r"segments\.0.*end 2 is not behind start 3",
    "segments: [{music: song.wav, start: -1}]": r"segments\.0\.start",
    "segments: [{music: song.wav, seconds: 2, end: 1}]": r"segments\.0.*give seconds or end, not both",
    "segments: [{music: song.wav, end: 20}]": r"show\.yaml: segments\.0: song\.wav is 6.0 s long",
    "segments: [{text: a, seconds: 1}, {music: song.wav, start: 9}]":
        r"show\.yaml: segments\.1: song.wav is 6.0 s long and 9 s to its end was asked for; shorten it",
    "segments: [{music: song.wav, start: 5, seconds: 4}]": r"segments\.0: song.wav .* 5 s to 9 s",
    "segments: [{music: other.wav}]": "other.wav: no such sound file",
    "segments: [{music: .}]": "no such sound file",
    "segments: [{text: a, seconds: 1": "show.yaml",
}  # fmt: skip


@pytest.mark.parametrize("text", list(MISTAKES))
def test_mistakes_are_one_sentence_that_names_file_and_key(text: str, write: Write) -> None:
    path = write(text)
    with pytest.raises(UserError, match=MISTAKES[text]) as caught:
        opened(path)
    assert re.search(r"show\.yaml|\.wav|tmp", str(caught.value)), caught.value
    assert "\n" not in str(caught.value)


def test_a_missing_script_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"none\.yaml"):
        Script.read(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.mp3", b"\xff\xfb\x90\x00" + b"no music at all" * 200, "a.mp3"),
        ("b.mp3", b"", "b.mp3"),
        ("c.wav", b"RIFF\x10\x00\x00\x00WAVEnothing", "c.wav"),
        ("d.ogg", b"OggS" + bytes(500), "d.ogg"),
        ("e.flac", b"plain text", "e.flac"),
    ],
)
def test_broken_sound_files_are_named(
    name: str, content: bytes, words: str, tmp_path: Path, write: Write
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=words) as caught:
        opened(write(f"segments: [{{music: {name}}}]"))
    assert "\n" not in str(caught.value)


def test_a_cut_mp3_is_named(tmp_path: Path, write: Write) -> None:
    soundfile.write(tmp_path / "whole.mp3", tune(5.0, 44_100), 44_100)
    data = (tmp_path / "whole.mp3").read_bytes()
    (tmp_path / "cut.mp3").write_bytes(data[: len(data) // 3])
    with pytest.raises(UserError, match=r"cut\.mp3: cut short"):
        opened(write("segments: [{music: cut.mp3}]"))


@pytest.mark.parametrize("loudest", [0.0, 5e-5])
def test_silence_is_refused(loudest: float, tmp_path: Path, write: Write) -> None:
    soundfile.write(tmp_path / "still.wav", tune(2.0) * 2 * loudest, 16_000, subtype="FLOAT")
    with pytest.raises(UserError, match=r"still\.wav: silent .*give music that can be heard"):
        opened(write("segments: [{music: still.wav}]"))


def test_a_script_says_everything(write: Write, tmp_path: Path) -> None:
    """Refused before a model is opened: there is none here."""
    path = write("segments: [{text: a person walks, seconds: 2}]")
    options: list[dict[str, Any]] = [
        {"captions": ["a person bows"]},
        {"audio": [tmp_path / "song.wav"]},
        {"seconds": 3.0},
        {"face": ["a happy face"]},
    ]
    for given in options:
        with pytest.raises(UserError, match="--script says everything: leave captions"):
            generate_motions(tmp_path, script=path, out=tmp_path / "out", console=None, **given)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="--samples 0: take 1 or more"):
        generate_motions(tmp_path, script=path, samples=0, out=tmp_path / "out", console=None)  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"nothing\.wav: no such sound file"):
        generate_motions(
            tmp_path, audio=[tmp_path / "nothing.wav"], out=tmp_path / "out", console=None  # type: ignore[arg-type]
        )  # fmt: skip


# ---- sound files of all kinds


@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("rate", [8_000, 22_050, 48_000])
@pytest.mark.parametrize("kind", ["wav", "flac", "mp3", "ogg"])
def test_formats_rates_and_channels(kind: str, rate: int, channels: int, tmp_path: Path) -> None:
    """The same tone from every file: its length, its loudness, its pitch."""
    left = tune(1.5, rate)
    stereo = np.stack([left, 0.5 * left], 1) if channels == 2 else left
    soundfile.write(tmp_path / f"song.{kind}", stereo, rate)
    sound = read_music(tmp_path / f"song.{kind}")
    assert sound.rate == rate and sound.seconds == pytest.approx(1.5, abs=0.06)
    inner = sound.samples[rate // 4 : rate]
    assert np.sqrt(np.mean(inner**2)) == pytest.approx(
        0.5 / np.sqrt(2) * (0.75 if channels == 2 else 1), rel=0.05
    )
    spectrum = np.abs(np.fft.rfft(inner * np.hanning(len(inner))))
    assert np.argmax(spectrum) * rate / len(inner) == pytest.approx(440, abs=3)


# ---- the sound of a whole motion


def driven(sound: Sound | None) -> DrivenSegment:
    return DrivenSegment(Prompt("x", sound=sound), 0.0, "x")


def test_sound_of_a_motion_is_silent_where_text_is() -> None:
    song = Sound(tune(2.0), 16_000)
    whole = sound_of([(driven(None), 20), (driven(song), 40), (driven(None), 10), (driven(song), 30)], 20.0)
    assert whole is not None and whole.rate == 16_000 and whole.seconds == pytest.approx(5.0)
    pieces = np.split(whole.samples, [16_000, 48_000, 56_000])
    assert not pieces[0].any() and not pieces[2].any()
    assert np.array_equal(pieces[1], song.samples) and np.array_equal(pieces[3], song.samples[:24_000])


def test_sounds_of_several_rates_meet_at_the_highest() -> None:
    low, high = Sound(tune(1.0, 8_000), 8_000), Sound(tune(1.0, 32_000, 660), 32_000)
    whole = sound_of([(driven(low), 20), (driven(high), 20), (driven(low), 30)], 20.0)
    assert whole is not None and whole.rate == 32_000 and len(whole.samples) == 112_000
    assert np.array_equal(whole.samples[32_000:64_000], high.samples)
    inner = whole.samples[4_000:28_000]
    np.testing.assert_allclose(inner, tune(1.0, 32_000)[4_000:28_000], atol=0.01)
    assert not whole.samples[96_100:].any(), "music that ends before its segment is followed by silence"


def test_without_music_there_is_no_sound() -> None:
    assert sound_of([(driven(None), 20)], 20.0) is None
