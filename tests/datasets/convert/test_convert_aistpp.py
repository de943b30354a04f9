"""AIST++: what is in the fixture comes out, in metres, in time, with its music; what is broken does not."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st

from motionloom.datasets.audio.features import AudioSettings, audio_features, beats
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Manifest
from motionloom.datasets.check.dataset import check
from motionloom.datasets.convert.aistpp.accompaniment import kinematic_beats, phase_of
from motionloom.datasets.convert.aistpp.convert import MOTION_LICENCE, MUSIC_LICENCE, AistppConfig
from motionloom.datasets.convert.aistpp.pickle_reader import read_aist_motion
from motionloom.datasets.convert.common.conversion import run_conversion
from motionloom.datasets.convert.registry import prepare
from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.canonical import canonicalize
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.music.recording import PLAYED, player

REAL = "gBR_sBM_cAll_d04_mBR0_ch01"
IGNORED = "gBR_sBM_cAll_d04_mBR0_ch08"
TEST = "gHO_sBM_cAll_d99_mHO9_ch01"
LISTED = "gBR_sBM_cAll_d04_mBR0_ch99"  # in the val split, without a file


@pytest.fixture(scope="module")
def fixture(shared: Path) -> Path:
    return shared / "data/layouts/aistpp"


def save_motion(folder: Path, name: str, frames: int = 120, **changes: Any) -> None:
    """A figure that stands still and turns a little."""
    poses = np.zeros((frames, 72), np.float32)
    poses[:, 1] = np.linspace(0, 1, frames)
    data = {
        "smpl_loss": 0.0,
        "smpl_poses": poses,
        "smpl_scaling": np.array([90.0], np.float32),
        "smpl_trans": np.tile(np.float32([10, 90, -20]), (frames, 1)),
    }
    (folder / "motions" / f"{name}.pkl").write_bytes(pickle.dumps(data | changes, protocol=2))


def silent(folder: Path, **options: Any) -> AistppConfig:
    return AistppConfig(source=folder, sound="none", **options)


def convert(config: AistppConfig, out: Path, **options: Any) -> Manifest:
    return run_conversion(prepare(config), out, progress=False, **options)


def clip_of(out: Path, split: str, clip_id: str) -> tuple[ShardDataset, int]:
    reader = ShardDataset.open(out, split)
    return reader, next(i for i in range(len(reader)) if reader.meta(i).id == clip_id)


def real_joints(fixture: Path, body: BodyModel) -> np.ndarray:
    poses, trans = read_aist_motion(fixture / f"motions/{REAL}.pkl")
    return smpl_joints(poses.reshape(-1, 24, 3)[:, :22], trans, body)


# ---- motion


def test_a_genuine_file_is_read_as_pickle_reads_it(shared: Path, tmp_path: Path) -> None:
    path = shared / f"data/real/aistpp/{REAL}.pkl"
    (tmp_path / "motions").mkdir()
    shutil.copy(path, tmp_path / "motions")
    prepared = prepare(AistppConfig(source=tmp_path, sound="none"))
    joints = prepared.converter.joints(prepared.plan.items[0][1]).joints
    data = pickle.loads(path.read_bytes())
    poses = data["smpl_poses"].astype(np.float64).reshape(720, 24, 3)[:, :22]
    trans = data["smpl_trans"].astype(np.float64) / float(data["smpl_scaling"][0])
    wanted = smpl_joints(poses, trans, BodyModel.neutral("smpl22"))
    np.testing.assert_allclose(joints, wanted, atol=1e-9)


@pytest.mark.parametrize("fps", [20.0, 30.0, 60.0])
def test_joints_and_parameters_tell_the_same_motion(fixture: Path, tmp_path: Path, fps: float) -> None:
    body = BodyModel.neutral("smpl22")
    wanted = canonicalize(real_joints(fixture, body)[:: round(60 / fps)])
    frames = len(wanted)
    for layout in ("body133", "smpl75", "h3d263"):
        out = tmp_path / layout
        manifest = convert(silent(fixture, layout=layout, fps=fps), out)
        assert check(out) == []
        assert (manifest.layout, manifest.fps) == (layout, fps)
        reader, i = clip_of(out, "train", REAL)
        motion = reader.motion(i)
        if layout == "smpl75":
            assert motion.shape == (frames, 75)
            angles = motion[:, 3:].reshape(frames, 24, 3)
            joints = smpl_joints(angles[:, :22].astype(float), motion[:, :3].astype(float), body)
            assert np.linalg.norm(angles, axis=-1).max() <= np.pi + 1e-5
            assert abs(joints[..., 1].min()) < 1e-5
            assert np.abs(joints[0, 0, [0, 2]]).max() < 1e-6
            assert np.abs(joints - wanted).max() < 1e-5
        elif layout == "body133":
            joints = decode(motion, MotionLayout.named(layout, fps=fps))
            assert np.abs(joints - wanted).max() < 1e-4
        else:
            assert motion.shape == (frames - 1, 263)


# ---- plan


def test_plan_of_the_fixture(fixture: Path) -> None:
    plan = prepare(AistppConfig(source=fixture)).plan
    assert [(split, clip.id) for split, clip in plan.items] == [("train", REAL), ("test", TEST)]
    assert plan.totals.frames == {"train": 240, "val": 0, "test": 60}
    assert plan.totals.found == 3
    assert [(d.source, d.reason) for d in plan.dropped] == [(f"motions/{IGNORED}.pkl", "on the ignore list")]
    assert [d.source for d in plan.missing] == [LISTED]
    assert plan.broken == []
    assert plan.totals.licences == {MUSIC_LICENCE: 2}


def test_official_lists_are_read_whole(fixture: Path) -> None:
    plan = prepare(silent(fixture, splits=fixture / "official_splits")).plan
    notes = plan.notes
    assert len(plan.missing) == 952 + 20  # 28 of the 980 are on the ignore list of the release
    assert any(note.startswith("28 sequences") for note in notes)
    assert plan.items == []
    assert sum(d.reason == "in no split file" for d in plan.dropped) == 2


def test_ignore_list_with_suffixes_and_unlisted_sequences(copy: Path) -> None:
    (copy / "ignore_list.txt").write_text(f"\n{REAL}.json \r\n\n{IGNORED}.pkl")
    save_motion(copy, "gPO_sFM_cAll_d10_mPO0_ch01")
    plan = prepare(silent(copy)).plan
    assert {d.source.split("/")[1]: d.reason for d in plan.dropped} == {
        f"{REAL}.pkl": "on the ignore list",
        f"{IGNORED}.pkl": "on the ignore list",
        "gPO_sFM_cAll_d10_mPO0_ch01.pkl": "in no split file",
    }
    shutil.rmtree(copy / "splits")
    plan = prepare(silent(copy)).plan
    assert len(plan.items) == 2
    assert any("80/5/15" in note for note in plan.notes)


# ---- music


def test_music_goes_with_the_motion(fixture: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    manifest = convert(AistppConfig(source=fixture, fps=60.0, sound_rate=8000, caption_genre=True), out)
    assert check(out) == []
    assert manifest.audio is not None
    assert str(tmp_path) not in str(manifest.dump()) and str(fixture) not in str(manifest.dump())
    reader, i = clip_of(out, "train", REAL)
    audio, wav = reader.array(i, "audio.npy"), reader.wav(i)
    assert audio is not None and wav is not None
    assert reader.motion(i).shape[0] == 720
    assert audio.shape == (720, 438)
    music, rate = soundfile.read(fixture / "wavs/mBR0.wav", dtype="float32")
    assert (wav[1], rate) == (8000, 8000)
    assert np.array_equal(wav[0], music)
    assert ["break dance" in caption.text for caption in reader.texts(i)] == [True]
    assert reader.meta(i).song == "mBR0", "which other dances share"
    # The click track has 80 beats a minute: the onsets lie where the clicks are.
    onset = audio[:, 52]
    times = np.flatnonzero(onset > 0.5 * onset.max()) / 60
    assert np.abs((times + 0.375) % 0.75 - 0.375).max() < 0.06


def test_a_song_in_two_splits_is_said(fixture: Path, shared: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(fixture, copy)
    song = Sound.read(shared / "data/music/calmrace-ks.ogg", rate=22_050).samples[: 22_050 * 20]
    for name, samples in {"mBR0": song, "mHO9": 0.3 * song[7000:]}.items():
        soundfile.write(copy / f"wavs/{name}.wav", samples, 22_050)
    notes = prepare(AistppConfig(source=copy)).looked().plan.notes
    assert "mBR0.wav and mHO9.wav are one piece of music, in test, train" in notes


def test_music_analysed_at_its_own_rate(fixture: Path, tmp_path: Path) -> None:
    """Bailando's: eight frames to a row, of which the first has it at its own time."""
    config = AistppConfig(source=fixture, fps=60.0, layout="smpl75", audio_fps=7.5)
    convert(config, tmp_path / "out")
    reader, i = clip_of(tmp_path / "out", "train", REAL)
    found = reader.array(i, "audio.npy")
    music, rate = soundfile.read(fixture / "wavs/mBR0.wav", dtype="float32")
    wanted = audio_features(music, rate, AudioSettings(fps=7.5))
    assert found is not None and found.shape == (720, 438)
    np.testing.assert_array_equal(found[::8], wanted[:90])


def test_lengths_that_differ_are_cut_or_left_out(copy: Path) -> None:
    music, rate = soundfile.read(copy / "wavs/mBR0.wav", dtype="float32")
    soundfile.write(copy / "wavs/mBR0.wav", music[: round(11.3 * rate)], rate, subtype="FLOAT")
    plan = prepare(AistppConfig(source=copy)).plan
    clip = next(clip for _, clip in plan.items if clip.id == REAL)
    assert clip.last == 678
    assert plan.totals.frames["train"] == 226
    assert any(note.startswith("1 clips end") for note in plan.notes)
    soundfile.write(copy / f"wavs/{REAL}.wav", music[: round(10.9 * rate)], rate)  # its own comes first
    plan = prepare(AistppConfig(source=copy)).plan
    assert any("12.00 s" in d.reason and "10.90 s" in d.reason for d in plan.dropped)


# ---- music of our own


def test_silence_is_doubted(copy: Path) -> None:
    samples, rate = soundfile.read(copy / "wavs/mHO9.wav")
    soundfile.write(copy / "wavs/mHO9.wav", 1e-4 * samples, rate)
    notes = prepare(AistppConfig(source=copy)).looked().plan.notes
    assert ["mHO9" in note for note in notes if "sound is silent" in note] == [True]


def test_a_band_plays_at_the_tempo_and_phase_of_the_dance(fixture: Path, tmp_path: Path) -> None:
    """The genuine dance: its tempo is heard in what plays, and beats where it stops; CC BY 4.0 alone."""
    try:
        player(PLAYED).version()
    except UserError as error:
        pytest.skip(str(error))
    config = AistppConfig(source=fixture, music="band", sound_rate=32_000)
    shards = [convert(config, tmp_path / name) for name in ("one", "two")]
    assert [s.sha256 for s in shards[0].shards] == [s.sha256 for s in shards[1].shards]
    assert shards[0].licence == MOTION_LICENCE
    assert {d.source: "mHO9" in d.reason for d in shards[0].dropped}[f"motions/{TEST}.pkl"], "no such piece"
    reader, i = clip_of(tmp_path / "one", "train", REAL)
    meta, audio, wav = reader.meta(i), reader.array(i, "audio.npy"), reader.wav(i)
    assert audio is not None and wav is not None and meta.truth is not None
    assert (meta.licence, meta.song, len(audio)) == (MOTION_LICENCE, REAL, meta.frames)
    assert len(wav[0]) == 12 * wav[1]
    # 80 beats a minute; twice as many may be heard, each some 25 ms late.
    heard = beats(*wav)
    period = np.median(np.diff(heard))
    times = round(0.75 / period)
    assert meta.truth["bpm"] == 80 and times in (1, 2) and times * period == pytest.approx(0.75, rel=0.02)
    late = (heard - meta.truth["first_beat"] + period / 2) % period - period / 2
    assert 0.0 < np.median(late) < 0.05
    # The dance at 80 a minute, and at no other of AIST's tempi.
    stops, weights = kinematic_beats(real_joints(fixture, BodyModel.neutral("smpl22")), 60.0)
    assert phase_of(stops, weights, 0.75) == meta.truth["first_beat"]

    def met(bpm: int) -> float:
        first = phase_of(stops, weights, 60 / bpm)
        away = (stops - first + 30 / bpm) % (60 / bpm) - 30 / bpm
        return float(np.mean(np.abs(away) < 0.05))

    assert max(map(met, range(80, 140, 5)), key=float) == met(80) > 0.8


@given(
    bpm=st.integers(80, 135), phase=st.floats(0, 1, exclude_max=True), seed=st.integers(0, 10**6),
    fps=st.sampled_from([30.0, 60.0]),
)  # fmt: skip
@settings(max_examples=40, deadline=None)
def test_planted_beats_are_found_to_one_frame(bpm: int, phase: float, seed: int, fps: float) -> None:
    """A dance that stops on each beat, to which it adds stops elsewhere, halts and trembling."""
    rng = np.random.default_rng(seed)
    # The step that ends at a frame has the speed of the middle between it and the frame before.
    period, t = 60 / bpm, (np.arange(round(12 * fps)) - 0.5) / fps
    speed = np.abs(np.sin(np.pi * (t / period - phase)))
    for at in rng.uniform(0, 12, 4):
        speed *= 1 - 0.9 * np.exp(-((t - at) ** 2) / (2 * 0.05**2))
    speed = speed + 0.05 * rng.random(len(t))
    joints = np.cumsum(speed)[:, None, None] / fps * rng.standard_normal((1, 22, 3))
    found = phase_of(*kinematic_beats(joints, fps), period)
    away = (found - phase * period + period / 2) % period - period / 2
    assert abs(away) <= 1 / fps
