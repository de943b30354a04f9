"""Retrieval metrics against golden vectors of T2M-GPT, OpenTMA and TMR, and against sorting."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from motionloom.models.metrics import retrieval
from motionloom.models.metrics.distributions import diversity, fid, frechet_distance, multimodality
from motionloom.models.metrics.retrieval import (
    accuracy_among,
    matching_score,
    other_texts,
    r_precision,
    ranks,
    recall,
)


def close(value: torch.Tensor, expected: torch.Tensor) -> None:
    torch.testing.assert_close(value.double(), expected.double(), rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("batch", [32, 256])
def test_r_precision_and_matching_equal_public_ones(golden: dict[str, torch.Tensor], batch: int) -> None:
    text = golden["text"]
    for name in ("pred", "gt"):
        close(r_precision(text, golden[name], batch=batch), golden[f"rprec_{name}_B{batch}"])
        close(matching_score(text, golden[name], batch=batch), golden[f"match_{name}_B{batch}"])
    close(r_precision(text, golden["pred"], batch=batch), golden[f"opentma_R_precision_B{batch}"])
    unit = {key: F.normalize(golden[key], dim=-1) for key in ("text", "pred", "gt")}
    for name, tag in (("pred", "TMR"), ("gt", "TMR_gt")):
        close(
            r_precision(unit["text"], unit[name], batch=batch), golden[f"opentma_{tag}_R_precision_B{batch}"]
        )
        close(
            matching_score(unit["text"], unit[name], batch=batch),
            golden[f"opentma_{tag}_Matching_score_B{batch}"],
        )


def test_what_is_no_number_is_found_last() -> None:
    text = torch.eye(8)
    lost = torch.where(torch.arange(8)[:, None] < 4, torch.nan, text)
    for pair in ((text, lost), (lost, text)):
        assert r_precision(*pair, batch=8).tolist() == [0.5, 0.5, 0.5]
    assert recall(text, torch.full_like(text, torch.nan))["t2m/R@1"] == 0
    assert accuracy_among(lost, text, other_texts(torch.arange(8), 3))["top-1"] <= 0.5


@pytest.fixture(params=[512, 7])
def in_blocks(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows that are compared with all others at a time."""
    monkeypatch.setattr(retrieval, "_ROWS", request.param)


@pytest.mark.usefixtures("in_blocks")
@pytest.mark.parametrize("threshold", [None, 0.9])
def test_recall_equals_tmr(golden: dict[str, torch.Tensor], threshold: float | None) -> None:
    """TMR's threshold 0.95 is the cosine 2 * 0.95 - 1 = 0.9; it reports percent."""
    sentence = golden["tmr_sent_emb"] if threshold else None
    out = recall(golden["text"][:128], golden["gt"][:128], sentence=sentence, threshold=threshold)
    expected = golden["tmr_retrieval_thr095" if threshold else "tmr_retrieval_plain"].tolist()
    mine = []
    for way in ("m2t", "t2m"):
        mine.append(out[f"{way}/MedR"])
        mine += [100 * out[f"{way}/R@{k}"] for k in (1, 2, 3, 5, 10)]
        mine.append(out["size"])
    assert mine == pytest.approx(expected, rel=1e-5)


def test_small_sets_are_easier_and_seeded(golden: dict[str, torch.Tensor]) -> None:
    text, motion = golden["text"], golden["gt"]
    full, c, d = (recall(text, motion, batch=n, seed=1) for n in (None, 256, 32))
    assert full["t2m/R@1"] < c["t2m/R@1"] < d["t2m/R@1"]
    assert (full["size"], c["size"], d["size"]) == (600, 256, 32)
    assert recall(text, motion, batch=32, seed=1) == d
    assert recall(text, motion, batch=32, seed=2) != d
    assert recall(text[:20], motion[:20], batch=256, seed=0) == recall(text[:20], motion[:20])


@pytest.mark.usefixtures("in_blocks")
def test_latents_as_they_are_are_compared_by_distance(golden: dict[str, torch.Tensor]) -> None:
    """Against sorting; by cosine the order is another one."""
    text, motion = golden["text"][:60], golden["pred"][:60]
    found = recall(text, motion, recalls=(1, 5), distance="euclidean")
    near = (text.double()[:, None] - motion.double()[None]).square().sum(-1)
    places = [near[i].argsort().tolist().index(i) for i in range(60)]
    back = [near[:, i].argsort().tolist().index(i) for i in range(60)]
    for way, order in (("t2m", places), ("m2t", back)):
        for k in (1, 5):
            assert found[f"{way}/R@{k}"] == pytest.approx(sum(place < k for place in order) / 60)
    assert found != recall(text, motion, recalls=(1, 5))


@settings(max_examples=30, deadline=None)
@given(n=st.integers(1, 12), seed=st.integers(0, 999))
def test_ranks_equal_sorting(n: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    distance = torch.randn(n, n, generator=generator)
    positive = torch.rand(n, n, generator=generator) > 0.8
    positive.fill_diagonal_(True)
    plain, best = ranks(distance), ranks(distance, positive)
    for i in range(n):
        order = distance[i].argsort().tolist()
        assert plain[i] == order.index(i)
        assert best[i] == next(place for place, column in enumerate(order) if positive[i, column])


def test_a_collapsed_encoder_is_not_perfect() -> None:
    same = torch.ones(100, 8)
    out = recall(same, same)
    assert out["t2m/R@1"] == out["t2m/R@10"] == 0
    assert r_precision(same, same).tolist() == [0, 0, 0]
    # Two equal captions share places 1 and 2: both are found within two.
    text = torch.eye(4)[[0, 0, 1, 2]]
    assert ranks(-(text @ text.T)).tolist() == [0.5, 0.5, 0, 0]


# FID, Diversity and MModality against golden vectors of T2M-GPT and OpenTMA, and known Gaussians.

WIDTH = 24


def test_equal_public_ones_under_their_seed(golden: dict[str, torch.Tensor]) -> None:
    seed = int(golden["div_seed"])
    for name in ("pred", "gt"):
        expected = golden[f"diversity_{name}"].item()
        assert diversity(golden[name], seed=seed).item() == pytest.approx(expected, rel=1e-5)
    mine = diversity(golden["pred"], seed=seed).item()
    assert mine == pytest.approx(golden["opentma_diversity_pred"].item(), rel=1e-5)
    mine = multimodality(golden["mm_embeddings"], seed=seed).item()
    assert mine == pytest.approx(golden["multimodality"].item(), rel=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_of_few_repeats_all_pairs_count_whatever_the_seed(seed: int) -> None:
    """A drawn pair of two repeats would be of one with itself every second time."""
    assert multimodality(torch.tensor([[[0.0], [3.0]], [[1.0], [2.0]]]), seed=seed).item() == 2
    assert multimodality(torch.tensor([[[0.0], [1.0], [5.0]]]), seed=seed).item() == pytest.approx(10 / 3)
    assert diversity(torch.ones(5, 3)).item() == 0
    with pytest.raises(ValueError, match="1 row"):
        diversity(torch.ones(1, 3))


def commuting(spread: torch.Tensor, other: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Covariances with the same axes, and their distance: the sum of (sqrt a - sqrt b)^2."""
    axes = torch.linalg.qr(
        torch.randn(WIDTH, WIDTH, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    )[0]
    truth = (spread.sqrt() - other.sqrt()).square().sum().item()
    return axes * spread @ axes.T, axes * other @ axes.T, truth


@pytest.mark.parametrize("least", [1.0, 1e-6, 1e-13, 0.0])
def test_distance_of_known_gaussians(least: float) -> None:
    """Well conditioned covariances take the Cholesky factor, others the symmetric root; both find the truth.

    Eigenvalues are known to 1e-16 of the largest, so a vanishing one's root to 1e-8, WIDTH times at most.
    """
    spread = torch.logspace(0, 1, WIDTH, dtype=torch.float64)
    spread[:8] *= least
    a, b, truth = commuting(spread, torch.linspace(1, 3, WIDTH, dtype=torch.float64))
    zero, one = torch.zeros(WIDTH, dtype=torch.float64), torch.ones(WIDTH, dtype=torch.float64)
    sure = 1e-12 if least > 1e-5 else 1e-6
    assert frechet_distance(zero, a, zero, b).item() == pytest.approx(truth, rel=sure)
    assert frechet_distance(zero, b, one, a).item() == pytest.approx(truth + WIDTH, rel=sure)
    assert frechet_distance(zero, a, zero, a).item() == pytest.approx(0.0, abs=WIDTH * 1e-6)


def test_fid_equals_public_ones(golden: dict[str, torch.Tensor]) -> None:
    pred, gt = golden["pred"], golden["gt"]
    for name, mine, rel in (
        ("fid_pred_gt", fid(pred, gt), 1e-5),
        ("fid_opentma", fid(gt, pred), 1e-5),
        ("fid_pred_gt_float64", fid(pred, gt), 1e-9),
        ("fid_singular_40", fid(pred[:40], gt[:40]), 1e-3),
    ):
        assert mine.item() == pytest.approx(golden[name].item(), rel=rel), name
