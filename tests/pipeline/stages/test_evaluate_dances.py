"""Dances from figures to the page: a tiny UDE run on SMPL parameters, and motions whose figures are known."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from motionloom.datasets.actions.dances import beats_of
from motionloom.datasets.audio.features import beats
from motionloom.datasets.motion.canonical import resample
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.dances import DanceConditions, DanceConfig
from motionloom.datasets.synth.generate import SynthConfig, make_clip, synthesize
from motionloom.models.metrics.dance import dance_fid
from motionloom.pipeline.evaluation.clip_metrics import Performance, measure_clip, metrics_of
from motionloom.pipeline.evaluation.dances import (
    DanceClip,
    commonest,
    dance_at,
    dances_of,
    digest_of_dances,
    other_songs,
)
from motionloom.pipeline.evaluation.estimate import row_estimates
from motionloom.pipeline.evaluation.figures import (
    MODEL,
    NEAREST,
    NEAREST_MUSIC,
    OTHER_MUSIC,
    RANDOM_DANCE,
    RECORDED,
    STILL,
    FigureFile,
)
from motionloom.pipeline.evaluation.movement import all_features, distances, movement_figures
from motionloom.pipeline.evaluation.reference_baselines import mean_poses, nearest_dances, random_dances
from motionloom.pipeline.inference.generators.ude import UdeGenerator
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.runs.api import evaluate_run, run_recipe

FPS = 20.0
Splits = tuple[ClipDataset, ClipDataset]
CONFIG = SynthConfig(
    clips=24, seed=5, layout="smpl75", fps=FPS, actions=["dance"], min_seconds=4.0, max_seconds=6.0,
    test_fraction=0.5, val_fraction=0.0,
    dances=DanceConfig(songs=12, song_seconds=10.0, conditions=DanceConditions(audio=1, both=0)),
)  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Splits:
    root = tmp_path_factory.mktemp("dances")
    synthesize(CONFIG, root, progress=False)
    return ShardDataset.open(root, "train"), ShardDataset.open(root, "test")


@pytest.fixture(scope="module")
def clips(data: Splits) -> list[DanceClip]:
    return dances_of(data[1], 20, unit=4)


def test_clips_are_cut_with_their_music(data: Splits, clips: list[DanceClip]) -> None:
    for clip in clips:
        made = make_clip(int(clip.id.rpartition("-")[2]), CONFIG)
        frames = len(clip.joints)
        assert frames == len(made.joints) // 4 * 4
        np.testing.assert_allclose(clip.joints, made.joints[:frames], atol=1e-5)
        assert made.wav is not None and clip.sound.rate == made.wav[1]
        # Sound is stored with 16 bits.
        np.testing.assert_allclose(clip.sound.samples, made.wav[0][: len(clip.sound.samples)], atol=1e-4)
        assert clip.sound.seconds == pytest.approx(clip.seconds, abs=1 / clip.sound.rate)
        assert clip.beats.tolist() == beats_of(made.truth, clip.seconds)
        # What a model hears is what the data store: of the whole song, not of the clip alone.
        assert clip.music is not None and np.array_equal(
            clip.music, data[1].array(clip.index, "audio.npy")[:frames]
        )
    short = dance_at(data[1], clips[0].index, seconds=2.0)
    assert short is not None and short.music is not None and len(short.music) == 40
    assert short is not None and short.seconds == 2.0 and short.sound.seconds == pytest.approx(2.0)
    assert (short.beats < 2.0).all() and len(short.beats) == (clips[0].beats < 2.0).sum()


def test_beats_without_a_truth_are_tracked(data: Splits, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = data[1]
    meta = dataset.meta(0)
    monkeypatch.setattr(dataset, "meta", lambda i: meta.model_copy(update={"truth": None}), raising=True)
    clip = dance_at(dataset, 0)
    assert clip is not None and clip.song == clip.id and clip.truth is None
    assert clip.beats.tolist() == beats(clip.sound.samples, clip.sound.rate).tolist()


def values(pairs: Iterable[tuple[np.ndarray, DanceClip]]) -> dict[str, float]:
    """Means over motions, each held against a clip."""
    rows = [
        measure_clip(metrics_of("dances"), Performance(m, c.joints, c.fps, truth=c.truth, beats=c.beats))
        for m, c in pairs
    ]
    return {name: found.value for name, found in row_estimates([rows]).items()}


def test_figures_tell_the_truth_from_trivial_answers(data: Splits, clips: list[DanceClip]) -> None:
    real = [clip.joints for clip in clips]
    apart = other_songs(clips, 3, seed=1)
    assert all(clips[k].song != clip.song for clip, row in zip(clips, apart, strict=True) for k in row)
    true = values(zip(real, clips, strict=True))
    crossed = values((m, clips[k]) for m, row in zip(real, apart, strict=True) for k in row)
    pool = dances_of(data[0], 50)
    still = mean_poses([c.joints for c in pool], pool[0].fps, map(len, real))
    frozen = values(zip(still, clips, strict=True))
    late = [np.concatenate([np.tile(j[:1], (4, 1, 1)), j[:-4]]) for j in real]  # a fifth of a second
    delayed = values(zip(late, clips, strict=True))
    for name in ("beat_align.bailando", "beat_align.mint"):
        assert true[name] > 0.7 > 0.5 > crossed[name] > frozen[name] == 0.0
        assert delayed[name] < 0.4
    for name in ("genre", "style", "tempo"):
        assert true[f"recognition.{name}"] == 1.0
    assert true["recognition.tempo_error"] < 0.02 and frozen["recognition.tempo"] < 0.5
    assert frozen["recognition.genre"] <= commonest(clips)["genre"]
    assert frozen["feet.skating"] == frozen["feet.contact"] == 0.0
    slid = [joints + np.linspace(0, 10, len(joints))[:, None, None] * [1, 0, 0] for joints in real]
    assert values(zip(slid, clips, strict=True))["feet.skating"] > 0.5 > true["feet.skating"]

    features = all_features(real, FPS)
    same, gone = distances(features, features), distances(features, all_features(still, FPS))
    assert max(same["movement.fid_k"], same["movement.fid_m"]) == pytest.approx(0, abs=1e-3)
    assert gone["movement.fid_m"] > 1 and same["movement.div_k"] > 1
    assert max(gone["movement.div_k"], gone["movement.div_m"]) < 1e-9


def test_distances_are_to_all_dances_and_beside_them_to_the_test_clips(
    data: Splits, clips: list[DanceClip]
) -> None:
    """As published: features, training and test, normalise and are the reference; few rows are said."""
    real = all_features([clip.joints for clip in clips], FPS)
    train = all_features([clip.joints for clip in dances_of(data[0], 50)], FPS)
    whole = {kind: np.concatenate([train[kind], real[kind]]) for kind in real}
    found = {(one.name, one.row): one for one in movement_figures(whole, real, {RECORDED: [real]}, {})}
    for kind, width in (("k", 66), ("m", 32)):
        published, ours = (found[f"movement.fid_{kind}{end}", RECORDED] for end in ("", "_test"))
        assert published.value == pytest.approx(dance_fid(whole[kind], real[kind])) and published.value > 1
        assert ours.value == pytest.approx(0, abs=1e-3)
        assert published.note == ours.note and re.findall(r"\d+", ours.note) == [str(len(clips)), str(width)]
        assert found[f"movement.div_{kind}", RECORDED].note == ""


def test_features_are_taken_at_the_published_rate(clips: list[DanceClip]) -> None:
    """A motion stored at 60 frames a second, and the same at 20, give features of one size."""
    fast = [resample(clip.joints, FPS, 60.0) for clip in clips]
    for kind, rows in all_features(fast, 60.0).items():
        np.testing.assert_allclose(all_features([c.joints for c in clips], FPS)[kind], rows, atol=1e-12)


def test_the_digest_sees_motions_and_beats(clips: list[DanceClip]) -> None:
    moved = replace(clips[0], joints=clips[0].joints + 1e-3)
    later = replace(clips[0], beats=clips[0].beats + 0.1)
    found = {digest_of_dances(some) for some in (clips, [moved, *clips[1:]], [later, *clips[1:]], clips[1:])}
    assert len(found) == 4 and digest_of_dances([replace(clips[0], id="x"), *clips[1:]]) in found


def test_trivial_answers_come_from_training_dances(data: Splits, clips: list[DanceClip]) -> None:
    train, test = data
    pool = dances_of(train, 50)
    assert not {c.song for c in pool} & {c.song for c in clips}
    for joints, clip in zip(random_dances(pool, clips, np.random.default_rng(0)), clips, strict=True):
        assert len(joints) <= len(clip.joints)
        near = [np.abs(other.joints[s : s + len(joints)] - joints).max() for other in pool
                for s in range(len(other.joints) - len(joints) + 1)]  # fmt: skip
        assert min(near) == 0
    itself = nearest_dances(train, pool, train, pool)
    assert itself is not None
    assert all(np.array_equal(found, clip.joints) for found, clip in zip(itself, pool, strict=True))
    known = nearest_dances(train, pool, test, clips)
    assert known is not None and [len(j) for j in known] == [
        min(len(c.joints), max(len(p.joints) for p in pool)) for c in clips
    ]


RECIPE = """
extends: ude-tiny
name: dances
seed: 7
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data:
    {clips: 40, layout: smpl75, min_seconds: 2.0, max_seconds: 5.0, test_fraction: 0.34,
     dances: {songs: 9, song_seconds: 8, share: 0.5, conditions: {audio: 1.0, both: 0.0}}}
  tma: null
  tokenizer:
    net: {width: 16, code_dim: 8, num_codes: 16, root_gain: 1.0, finger_gain: 0.0}
    train: {steps: 2, batch_size: 4, checkpoint_every: 2, validate_every: 2}
  utt:
    net: {layers: 1, dim: 16, heads: 2, ff: 16, block_size: 48, z_dim: 4}
    mate: {dim: 16, layers: 1, heads: 2, ff: 16}
    loss: {adversarial_start: 2, adversarial_ramp: 2, discriminator: {dim: 16, ff: 16, heads: 2}}
    train: {steps: 2, batch_size: 4, checkpoint_every: 2, validate_every: 2}
  dmd:
    net: {dim: 16, ff: 16, encoder_layers: 1, decoder_layers: 1, heads: 2}
    train: {steps: 2, batch_size: 4, checkpoint_every: 2, validate_every: 2}
  ude: {denoising_steps: 2}
  generate: {count: 1, dances: 2, dance_seconds: 2, formats: [html, npz]}
  evaluate: {clips: 4}
  evaluate_dances: {kind: evaluate_dances, clips: 4, repeats: 2, decodings: 2}
  report: {count: 1, dances: 2}
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A finished run on SMPL parameters, of captioned clips and dances without captions; what it printed."""
    root = tmp_path_factory.mktemp("ude")
    (root / "dances.yaml").write_text(RECIPE)
    said = io.StringIO()
    run_recipe(root / "dances.yaml", root / "run", console=Console(file=said, width=200))
    return root / "run", said.getvalue()


def page_data(path: Path, name: str = "viewer-1-data") -> dict[str, Any]:
    text = path.read_text()
    data: dict[str, Any] = json.loads(text.split(f'id="{name}">')[1].split("</script>")[0])
    return data


def test_dances_of_a_run_are_evaluated(run: tuple[Path, str]) -> None:
    folder, said = run
    file = FigureFile.read(folder / "stages/evaluate_dances/metrics.json")

    def value(name: str, row: str = MODEL) -> float:
        found = file.of(name, row)
        assert found is not None, (name, row)
        return found.value

    facts = file.figures[0].protocol
    assert (facts["clips"], facts["repeats"], facts["decodings"], facts["feature_fps"]) == (4, 2, 2, 60.0)
    drawn = [facts[f"sampling.{name}"] for name in ("sampler", "denoising_steps", "temperature")]
    assert drawn == ["dpm++", 2, 0.8], "the stage's sampler and steps, beside a temperature of the recipe"
    answers = {OTHER_MUSIC, NEAREST_MUSIC, RANDOM_DANCE, STILL}
    assert answers | {MODEL, RECORDED} <= {one.row for one in file.figures}
    assert value("position.ape_joints", RECORDED) == 0 < value("position.ape_joints")
    assert value("recognition.genre", RECORDED) == 1 and value("movement.mm_k") >= 0
    # To all dances, as published, and to the test clips, ours.
    assert value("movement.fid_k", RECORDED) > 0 == value("movement.fid_k_test", RECORDED)
    for name in ("bailando", "mint"):
        key = f"beat_align.{name}"
        worse = (value(key, row) for row in {*answers, MODEL})
        assert value(key, RECORDED) > max(worse), "nothing was learned in two steps"
    assert "movement.fid_k" in said and RECORDED in said
    # Captioned clips and dances without captions beside each other, no TMA in the run.
    captions = FigureFile.read(folder / "stages/evaluate/metrics.json")
    assert not any(one.name.startswith("tma.") for one in captions.figures)
    near, still, made = (captions.of("reconstruction.mpjpe", row) for row in (NEAREST, STILL, MODEL))
    assert near is not None and still is not None and made is not None
    assert 0 < near.value < still.value and made.protocol["clips"] == 4


def test_the_same_tokens_are_decoded_with_other_noise(
    run: tuple[Path, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`decodings`: tokens are drawn once, the diffusion decoder's noise changes."""
    codes, decode = [], UdeGenerator.decode
    monkeypatch.setattr(UdeGenerator, "decode", lambda *given: codes.append(given[1]) or decode(*given))
    model = MotionModel(run[0])
    made = [model.generate(["a walk"], seconds=2.0, seed=3, noise_seed=noise) for noise in (1, 2, 1)]
    motions = [one[0].joints for one in made]
    assert len({id(code) for code in codes}) == 1
    np.testing.assert_array_equal(motions[0], motions[2])
    assert np.abs(motions[0] - motions[1]).max() > 1e-3


def test_the_page_plays_the_music(run: tuple[Path, str]) -> None:
    page = run[0] / "stages/report/report.html"
    words, dances = (page_data(page, f"viewer-{number}-data") for number in (1, 2))
    assert "sounds" not in words and [m["label"] for m in words["motions"]] == [
        "recorded", "reconstruction", "generated"
    ]  # fmt: skip
    assert len(dances["sounds"]) == 2 and len(dances["motions"]) == 6
    for motion in dances["motions"]:
        sound, score = dances["sounds"][motion["sound"]], dances["scores"][motion["score"]]
        assert sound["seconds"] == pytest.approx(motion["frames"] / motion["fps"], abs=0.01)
        assert score["beats"] and score["segments"][0][3] == "music"
    assert "media-src blob:" in page.read_text() and "Beat Align" in page.read_text()


def test_evaluate_runs_every_stage_of_figures(run: tuple[Path, str]) -> None:
    out = evaluate_run(run[0], clips=2, repeats=1, console=Console(quiet=True))
    for path in (out / "metrics.json", out / "evaluate_dances/metrics.json"):
        file = FigureFile.read(path)
        assert {one.protocol["clips"] for one in file.figures} == {2}
        assert file.of("movement.mm_k") is None or path.parent.name == "evaluate_dances", "decoded twice"
