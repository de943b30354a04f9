"""Retrieval metrics against golden vectors of T2M-GPT, OpenTMA and TMR, and against sorting."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from motionloom.models.metrics.retrieval import matching_score, r_precision, ranks, recall


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


def test_mistakes_are_named() -> None:
    with pytest.raises(ValueError, match="needs both"):
        recall(torch.eye(2), torch.eye(2), threshold=0.9)
    with pytest.raises(ValueError, match="row-aligned"):
        r_precision(torch.eye(2), torch.eye(3))
