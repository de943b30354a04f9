"""Figures of dances against the published implementations' numbers, and against obvious slow versions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from motionloom.models.metrics import retrieval
from motionloom.models.metrics.dance import (
    dance_diversity,
    dance_fid,
    dance_multimodality,
    foot_contact_score,
    foot_skating,
    normalized_by,
    physics,
)
from motionloom.models.metrics.dance_beats import alignment, beat_align, motion_beats
from motionloom.models.metrics.dance_features import kinetic_features, manual_features, zero_start
from motionloom.models.metrics.retrieval import accuracy_among, other_texts


@pytest.fixture(scope="module")
def golden(shared: Path) -> dict[str, np.ndarray]:
    with np.load(shared / "golden" / "t6_dance_A.npz", allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def test_features_and_the_foot_contact_score_are_the_published_ones(golden: dict[str, np.ndarray]) -> None:
    joints = golden["joints24_60fps"]
    # The published code adds up in float32.
    assert np.allclose(kinetic_features(joints), golden["kinetic72"], rtol=2e-4)
    assert np.allclose(kinetic_features(zero_start(joints)), golden["kinetic72_zero"], rtol=2e-4)
    assert np.allclose(kinetic_features(joints[::3]), golden["kinetic72_20fps_input"], rtol=2e-4)
    assert np.allclose(manual_features(joints), golden["manual32"], atol=1e-6)
    assert np.allclose(manual_features(zero_start(joints)), golden["manual32_zero"], atol=1e-6)
    assert np.isclose(foot_contact_score(joints[::2], 30.0), golden["pfc_edge"], rtol=1e-4)
    assert foot_contact_score(np.zeros((9, 12, 3)), 30.0) == 0


@pytest.mark.parametrize("kind", ["k", "m"])
def test_distances_and_diversity_are_the_published_ones(golden: dict[str, np.ndarray], kind: str) -> None:
    true, made = golden[f"feat_{kind}_gt"], golden[f"feat_{kind}_pred"]
    got = dance_fid(true, made)
    assert np.isclose(got, golden[f"bailando_fid_{kind}"], rtol=1e-5)
    assert np.isclose(got, golden[f"mint_fid_{kind}"], rtol=1e-5)
    assert np.isclose(dance_diversity(true, made), golden[f"bailando_div_{kind}_pred"], rtol=1e-5)
    assert np.isclose(dance_diversity(true, true), golden[f"bailando_div_{kind}_gt"], rtol=1e-5)


def test_a_statement_that_is_always_true_does_not_explode() -> None:
    rng = np.random.default_rng(1)
    true, made = rng.random((40, 3)), rng.random((40, 3))
    true[:, 1] = 1.0
    made[:, 1] = 0.5
    assert np.array_equal(normalized_by(true, made)[:, 1], np.full(40, -0.5))
    assert dance_fid(true, made) < 10


def test_multimodality_is_the_mean_of_each_input() -> None:
    rng = np.random.default_rng(2)
    true, made = rng.standard_normal((20, 4)), rng.standard_normal((3, 5, 4))
    scaled = (made - true.mean(0)) / true.std(0)
    wanted = np.mean(
        [np.linalg.norm(rows[i] - rows[j]) for rows in scaled for i in range(5) for j in range(i)]
    )
    assert np.isclose(dance_multimodality(true, made), wanted, rtol=1e-8)


def test_beats_and_alignment_are_the_published_ones(golden: dict[str, np.ndarray]) -> None:
    joints = golden["joints24_60fps"]
    for name in ("bailando", "mint"):
        found = np.round(motion_beats(joints, 60.0, name) * 60).astype(int)
        assert found.tolist() == golden[f"motion_beats_{name}"].tolist()
    own, other = golden["music_beats_bailando"] / 60, golden["music_beats_mint"] / 60
    assert np.isclose(beat_align(joints, own, 60.0), golden["bas_bailando"], rtol=1e-5)
    assert np.isclose(beat_align(joints, other, 60.0), golden["bas_bailando_mintbeats"], rtol=1e-5)
    assert np.isclose(beat_align(joints, other, 60.0, "mint"), golden["bas_mint"], rtol=1e-5)
    assert np.isclose(beat_align(joints, own, 60.0, "mint"), golden["bas_mint_bailandobeats"], rtol=1e-5)


@pytest.mark.parametrize("fps", [20.0, 30.0, 60.0])
@pytest.mark.parametrize("name", ["bailando", "mint"])
def test_a_body_that_stops_on_each_beat_is_aligned_at_any_rate(fps: float, name: str) -> None:
    beat, late = 0.6, 0.011  # beats between frames: no two steps are equally slow
    time = np.arange(round(6 * fps)) / fps - late
    swing = np.cos(np.pi * time / beat)[:, None, None] * np.ones((1, 3, 3))
    music = np.arange(1, 9) * beat + late
    on, off = (beat_align(swing, music + shift, fps, name) for shift in (0.0, beat / 2))
    # mint counts a step for its later frame: half a frame, which is half a sigma at 20 frames a second.
    assert on > 0.6
    assert off < 0.05


def test_alignment_without_beats() -> None:
    still = np.zeros((60, 3, 3))
    assert beat_align(still, np.array([0.5]), 60.0) == 0
    assert alignment(np.array([1.0]), np.array([1.0, 5.0]), "music", 0.05) == 1
    assert np.isclose(alignment(np.array([1.0]), np.array([1.0, 5.0]), "motion", 0.05), 0.5)


def test_sliding_feet_are_counted() -> None:
    joints = np.zeros((21, 12, 3))
    joints[:, 0, 1] = 1.0
    assert foot_skating(joints, 20.0) == 0
    joints[10:, 10, 0] = np.arange(11) * 0.05  # 1 m/s for ten of twenty steps of one of two feet
    assert foot_skating(joints, 20.0) == 0.25
    joints[:, 10, 1] = 0.2
    assert foot_skating(joints, 20.0) == 0


def test_accuracy_among_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(3)
    text = torch.randn(80, 16, generator=generator)
    alone = torch.arange(80)
    among = other_texts(alone, 60)
    assert accuracy_among(text, text, among) == {"top-1": 1.0, "top-5": 1.0}
    assert accuracy_among(torch.ones(80, 4), torch.ones(80, 4), among) == {"top-1": 0.0, "top-5": 0.0}
    chance = accuracy_among(torch.randn(80, 16, generator=generator), text, other_texts(alone, 4))
    assert chance["top-5"] == 1
    assert 0.05 < chance["top-1"] < 0.4
    # All texts among the candidates: the rank in the whole matrix.
    motion = text + 2.0 * torch.randn(80, 16, generator=generator)
    near = (
        torch.nn.functional.normalize(motion.double(), dim=-1)
        @ torch.nn.functional.normalize(text.double(), dim=-1).T
    )
    first = float((near.argmax(1) == alone).double().mean())
    assert accuracy_among(motion, text, other_texts(alone, 79))["top-1"] == first
    twins = torch.cat([text, text])
    drawn = other_texts(alone.repeat(2), 149)
    assert accuracy_among(twins, twins, drawn)["top-1"] == 1
    # One equal rival ties, which is right; two are before.
    assert accuracy_among(twins, twins, other_texts(torch.arange(160), 159))["top-1"] == 1
    triplets = torch.cat([text] * 3)
    assert accuracy_among(triplets, triplets, other_texts(torch.arange(240), 239))["top-1"] == 0
    # Drawn in blocks of rows as from one matrix of draws.
    draws = torch.rand(160, 160, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    draws[alone.repeat(2)[:, None] == alone.repeat(2)] = -1
    monkeypatch.setattr(retrieval, "_ROWS", 7)
    assert other_texts(alone.repeat(2), 30, seed=5).equal(draws.topk(30, dim=1).indices)


# Physics of motions whose answers are known.

FPS = 20.0


def standing(frames: int = 40) -> NDArray[np.float64]:
    """Twelve joints one above the other, both feet and toes on the floor."""
    joints = np.zeros((frames, 12, 3))
    joints[:, :, 1] = np.linspace(1.0, 0.1, 12)
    joints[:, [7, 8, 10, 11], 1] = 0.0
    return joints


def test_one_who_stands_does_nothing_wrong_and_sliding_is_not_standing() -> None:
    joints = standing()
    assert physics(joints, FPS) == (0.0, 0.0, 0.0, 0.0)
    joints[..., 0] += (np.arange(40) / FPS)[:, None]  # a metre a second
    assert physics(joints, FPS).skating == 1.0


def test_height_and_depth_are_millimetres_and_jitter_is_the_third_derivative() -> None:
    up, down, both = standing(), standing(), standing()
    up[..., 1] += 0.03
    down[..., 1] -= 0.02
    both[:10, :, 1] += 0.03
    both[10:20, :, 1] -= 0.02
    both[20:, :, 1] += 0.004  # on the floor, as far as it is known
    assert physics(up, FPS)[1:3] == pytest.approx((30.0, 0.0))
    assert physics(down, FPS)[1:3] == pytest.approx((0.0, 20.0))
    assert physics(both, FPS)[1:3] == pytest.approx((7.5, 5.0))
    # x = t^3 has the jerk 6 everywhere; a parabola has none.
    t = np.arange(40) / FPS
    joints = standing()
    joints[..., 0] += t[:, None] ** 3
    assert physics(joints, FPS).jitter == pytest.approx(0.06, rel=1e-6)
    joints = standing()
    joints[..., 2] += t[:, None] ** 2
    assert physics(joints, FPS).jitter == pytest.approx(0.0, abs=1e-9)
