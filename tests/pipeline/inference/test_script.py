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
from motionloom.pipeline.inference.script import DrivenSegment, Script, sound_of

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
        path.with_suffix(".wav").write_bytes(b"RIFF\x10\x00\x00\x00WAVEnothing")
        return path

    return go


def test_all_forms_of_a_segment(write: Write) -> None:
    path = write("""
segments:
  - {text: a person walks, seconds: 4}
  - text: a person bows
    face: a person smiles
    seconds: 1.5
  - {music: song.wav}
  - {music: song.wav@1-5.25, text: a person spins}
  - {music: song.wav@4-6.4}
  - {music: "song.wav@0:02-"}
  - {music: "song.wav@-3.5", text: a person spins}
""")
    found = Script.read(path)
    assert [s.seconds for s in found] == pytest.approx([4, 1.5, 6, 4.25, 2, 4, 3.5])
    spins = "a person spins + song"
    labels = ["a person walks", "a person bows", "song", spins, "song", "song", spins]
    assert [s.label for s in found] == labels
    assert found[1].prompt.face_text == found[1].prompt.words == "a person smiles"
    assert [s.prompt.sound is None for s in found] == [True, True, *[False] * 5]
    whole = Sound.read(path.parent / "song.wav").samples
    # None beyond the music.
    for segment, (first, last) in zip(found[2:], [(0, 6), (1, 5.25), (4, 6), (2, 6), (0, 3.5)], strict=True):
        sound = segment.prompt.sound
        assert sound is not None and sound.rate == 16_000
        assert np.array_equal(sound.samples, whole[round(first * 16_000) : round(last * 16_000)])
    assert found[3].prompt.modalities == {"text", "audio"}


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
    "segments: [{text: a, seconds: .nan}]": r"segments\.0\.seconds",
    "segments: [{text: a, seconds: soon}]": r"segments\.0\.seconds",
    "segments: [{text: a, seconds: 2, start: 1}]": r"unknown key 'segments\.0\.start'",
    "segments: [{music: song.wav, seconds: 2}]": r"segments\.0.*leave seconds out",
    "segments: [{music: song.wav@3-2}]": r"song\.wav@3-2: its end, 2, is not after its start, 3",
    "segments: [{text: a, seconds: 1}, {music: song.wav@9-}]":
        r"show\.yaml: segments\.1: song.wav@9- is 6.0 s long and 9 s to its end was asked for; shorten it",
    "segments: [{music: song.wav@2-20}]": r"segments\.0: song.wav@2-20 is 6.0 s long",
    "segments: [{music: other.wav}]": "other.wav: no such sound file",
    "segments: [{music: .}]": "no such sound file",
    "segments: [{music: show.wav}]": "show.wav",
    "segments: [{text: a, seconds: 1": "show.yaml",
}  # fmt: skip


@pytest.mark.parametrize("text", list(MISTAKES))
def test_mistakes_are_one_sentence_that_names_file_and_key(text: str, write: Write) -> None:
    path = write(text)
    with pytest.raises(UserError, match=MISTAKES[text]) as caught:
        Script.read(path)
    assert re.search(r"show\.yaml|\.wav|tmp", str(caught.value)), caught.value
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "more",
    [
        ["a person bows"],
        ["--audio", "song.wav"],
        ["--seconds", 3],
        ["--set", "face=smiles"],
        ["--samples", 0],
    ],
)
def test_a_script_says_everything(
    more: list[Any], write: Write, call: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Refused before a model is opened: there is none here."""
    path = write("segments: [{text: a person walks, seconds: 2}]")
    monkeypatch.chdir(path.parent)
    done = call("generate", "nowhere", path.name, *more)
    assert done.code == 2 and ("show.yaml" in done.err or "--samples" in done.err)


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
