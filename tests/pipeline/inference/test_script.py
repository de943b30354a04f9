"""Driving scripts: their forms and mistakes, sound files of all kinds, the sound of a whole motion."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.inference.files.display_figure import shown
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.script import DrivenSegment, Script, sound_of
from motionloom.pipeline.store.yaml import read_yaml

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
    "segments: [{text: a, seconds: 1e308}]": r"segments\.0\.seconds' = 1e\+308: .*3600",
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


# A trained UDE from the command line and from Python: songs, scripts, several samples, exports, refusals.

FPS = 20
Call = Callable[..., Any]


def song(seconds: float, rate: int = 22_050, beat: float = 0.5) -> np.ndarray:
    """A soft tone with a click on every beat."""
    t = np.arange(round(seconds * rate)) / rate
    since = t % beat
    click = 0.7 * np.sin(2 * np.pi * 1500 * since) * np.exp(-since * 400)
    return (0.1 * np.sin(2 * np.pi * 220 * t) + click).astype(np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two songs and a script of them."""
    place = tmp_path_factory.mktemp("songs")
    soundfile.write(place / "slow.wav", song(5.0), 22_050)
    soundfile.write(place / "fast.mp3", np.stack([song(4.0, 44_100, 0.3)] * 2, 1), 44_100)
    (place / "show.yaml").write_text("""
segments:
  - {text: a person walks forward, seconds: 2}
  - {music: slow.wav@1-4.5}
  - {music: fast.mp3@0-2, text: a person waves}
  - {text: a person squats, seconds: 1}
""")
    return place


@pytest.fixture(scope="module")
def model(ude_run: Any) -> MotionModel:
    return MotionModel.from_pretrained(ude_run.folder, device="cpu")


def joints_of(path: Path) -> np.ndarray:
    with np.load(path, allow_pickle=False) as file:
        found: np.ndarray = file["joints"]
    return found


def page_of(folder: Path) -> dict[str, Any]:
    text = (folder / "index.html").read_text("utf-8")
    found: dict[str, Any] = json.loads(re.search(r'id="viewer-data">(.*?)</script>', text, re.S)[1])  # type: ignore[index]
    return found


def loud(samples: np.ndarray, start: float, end: float) -> float:
    return float(np.abs(samples[round(start * 44_100) : round(end * 44_100)]).max())


BANDS = [
    [0.0, 2.0, "a person walks forward", "text"],
    [2.0, 5.6, "slow", "music"],
    [5.6, 7.6, "a person waves + fast", "music"],
    [7.6, 8.6, "a person squats", "text"],
]
"""3.5 s of music are 17.5 groups of four frames at 20 a second: 18."""


@pytest.mark.slow
def test_a_script_becomes_files_and_a_page(
    ude_run: Any, folder: Path, tmp_path: Path, call: Call, model: MotionModel
) -> None:
    out = tmp_path / "out"
    words = (folder / "show.yaml", "--samples", 2, "-f", "npz,bvh,html")
    done = call("generate", ude_run.folder, *words, "-o", out)
    assert done.code == 0, done.err
    stem = "a-person-walks-forward-slow-a-person-waves-fast"
    names = {f"0{k}-{stem}" for k in range(2)}
    expected = {f"{name}.{kind}" for name in names for kind in ("npz", "bvh")} | {"index.html"}
    assert {path.name for path in out.iterdir() if path.suffix} == expected
    frames = round(BANDS[-1][1] * FPS)  # type: ignore[operator]
    made = [joints_of(out / f"{name}.npz") for name in sorted(names)]
    assert all(joints.shape == (frames, 52, 3) and np.isfinite(joints).all() for joints in made)
    assert np.abs(made[0] - made[1]).max() > 1e-3
    for name in names:
        assert f"Frames: {frames}\n" in (out / f"{name}.bvh").read_text()
    page = page_of(out)
    assert [m["sound"] for m in page["motions"]] == [0, 0], "one sound, carried once"
    heard, rate = soundfile.read(io.BytesIO(base64.b64decode(page["sounds"][0]["data"])))
    assert rate == 44_100 and len(heard) / rate == pytest.approx(8.6, abs=0.05)
    # Text is silent, music is not.
    assert loud(heard, 0, 1.9) < 1e-3 and loud(heard, 7.75, 8.6) < 1e-3
    assert loud(heard, 2.1, 5.4) > 0.1 and loud(heard, 5.7, 7.5) > 0.1
    (score,) = page["scores"]  # of both
    assert [[pytest.approx(a), pytest.approx(b), *rest] for a, b, *rest in BANDS] == score["segments"]
    with chdir(folder):  # where a script from Python looks for its files
        (alone,) = model.perform(Script.parse(read_yaml(Path("show.yaml")), "show"))
    np.testing.assert_allclose(shown(alone).joints, made[0], atol=1e-4)  # other samples play no part


@pytest.mark.slow
def test_songs_become_dances_as_long_as_they_are(
    ude_run: Any, folder: Path, tmp_path: Path, call: Call, model: MotionModel
) -> None:
    out = tmp_path / "out"
    words = ("--audio", folder / "slow.wav", "--audio", folder / "fast.mp3", "--samples", 2, "--seed", 5)
    done = call("generate", ude_run.folder, *words, "-o", out, "-f", "npz,html")
    assert done.code == 0, done.err
    made = [joints_of(path) for path in sorted(out.glob("*.npz"))]
    assert [len(joints) for joints in made] == [100, 100, 80, 80]
    assert np.abs(made[0] - made[1]).max() > 1e-3
    assert [m["sound"] for m in page_of(out)["motions"]] == [0, 0, 1, 1]
    sounds = [Sound.read(folder / name) for name in ("slow.wav", "slow.wav", "fast.mp3", "fast.mp3")]
    again = model.generate(sounds=sounds, seed=5)
    for ours, theirs in zip(made, again, strict=True):
        np.testing.assert_allclose(ours, shown(theirs).joints, atol=1e-6)


@pytest.mark.slow
def test_words_beside_a_song_and_words_alone(model: MotionModel, folder: Path) -> None:
    sound = Sound.read(folder / "slow.wav")
    # Twelve steps have learnt little of words: of many draws some differ.
    spins, others = (model.generate([w] * 16, sounds=[sound] * 16, seed=1) for w in ("a person spins", "x"))
    both = spins[0]
    assert both.prompt.modalities == {"text", "audio"} and len(both.joints) == 100
    apart = [np.abs(a.joints - b.joints).max() for a, b in zip(spins, others, strict=True)]
    assert max(apart) > 1e-6, "the words are read too"
    free = model.generate(["a person walks"], seed=1)[0]
    assert 4 <= len(free.joints) <= 64 and free.prompt.sound is None
    some = model.generate(["a person walks", ""], sounds=[None, sound], seconds=2.0, seed=2)
    assert [len(motion.joints) for motion in some] == [40, 40]


@pytest.mark.slow
def test_an_export_gives_the_same_motions(
    ude_run: Any, folder: Path, tmp_path: Path, call: Call, model: MotionModel
) -> None:
    assert call("export", ude_run.folder, "-o", tmp_path / "model").code == 0
    there = {path.parent.name for path in (tmp_path / "model").glob("*/model.safetensors")}
    assert there == {"tokenizer", "utt", "dmd"}
    assert (tmp_path / "model/audio/audio.safetensors").is_file()
    shutil.move(tmp_path / "model", tmp_path / "elsewhere")
    exported = MotionModel.from_pretrained(tmp_path / "elsewhere", device="cpu")
    pairs = [
        (m.perform(folder / "show.yaml", seed=4)[0], m.generate(["a person walks"], seed=4)[0])
        for m in (model, exported)
    ]
    for ours, theirs in zip(*pairs, strict=True):
        assert np.array_equal(ours.features, theirs.features)


def refused(done: Any) -> str:
    """The one sentence on standard error."""
    assert done.code == 2 and done.err.count("\n") == 1, done.err
    return str(done.err)


@pytest.mark.slow
def test_models_of_one_modality_refuse_the_other(
    small_run: Any, ude_run: Any, folder: Path, tmp_path: Path, call: Call
) -> None:
    words = ("generate", small_run.folder, "-o", tmp_path / "out")
    assert "conditioned on text only" in refused(call(*words, "--audio", folder / "slow.wav"))
    assert "scripts need a UDE model" in refused(call(*words, folder / "show.yaml"))
    run = tmp_path / "run"
    shutil.copytree(ude_run.folder, run)
    shutil.rmtree(run / "stages/utt")
    only = ("--set", "utt.modalities=[audio]", "--until", "ude")
    done = call("run", ude_run.recipe, "--out", run, *only)
    assert done.code == 0, done.err
    words = ("generate", run, "-o", tmp_path / "out", "-f", "npz")
    assert "conditioned on audio only" in refused(call(*words, "a person walks"))
    assert "conditioned on audio only" in refused(call(*words, folder / "show.yaml"))
    assert not (tmp_path / "out").exists()
    assert call(*words, "--audio", folder / "slow.wav").code == 0


LONG = """
import resource, sys
from pathlib import Path
from motionloom.datasets.audio.sound import Sound
from motionloom.pipeline.inference.files.outputs import write_motions
from motionloom.pipeline.inference.model import MotionModel

model, folder = MotionModel.from_pretrained(sys.argv[1], device="cpu"), Path(sys.argv[2])
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
model.generate(sounds=[Sound.read(folder / "short.wav")])
before = peak()
motions = model.generate(sounds=[Sound.read(folder / "long.wav")])
write_motions(folder / "out", motions, ["npz", "html"], title="t")
print(len(motions[0].joints), (peak() - before) // 1024)
"""


@pytest.mark.slow
def test_a_song_of_two_minutes_takes_little_memory(ude_run: Any, tmp_path: Path) -> None:
    for name, seconds in (("short", 3.0), ("long", 120.0)):
        soundfile.write(tmp_path / f"{name}.wav", song(seconds), 22_050)
    done = subprocess.run(
        [sys.executable, "-P", "-c", LONG, str(ude_run.folder), str(tmp_path)],
        capture_output=True, text=True, timeout=280,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    frames, grown = map(int, done.stdout.split()[-2:])
    assert frames == 2400
    assert grown < 600, f"{grown} MiB more than for three seconds"
