"""TMA's network and Lightning module: masks, strides, noise and dropout of the text."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from motionloom.models.tma.losses import (
    false_negatives,
    info_nce,
    kl_divergence,
    kl_four,
    latent_loss,
    reconstruction_loss,
)
from motionloom.models.tma.network import Tma, TmaConfig, noisy

TINY = TmaConfig(latent=32, ff=64, layers=2, heads=2, dropout=0.0, attention_dropout=0.0)


@pytest.fixture
def net() -> Tma:
    torch.manual_seed(0)
    return Tma(TINY, motion_dim=6, text_dim=5).eval()


@pytest.mark.usefixtures("float64")
@torch.no_grad()
def test_padding_changes_nothing(net: Tma) -> None:
    motion, tokens = torch.randn(3, 10, 6), torch.randn(3, 7, 5)
    length, words = torch.tensor([10, 4, 7]), torch.tensor([7, 2, 1])
    mask = torch.arange(7)[None] < words[:, None]
    mu, logvar = net.encode_motion(motion, length)
    text_mu, _ = net.encode_text(tokens, mask)
    decoded = net.decode(mu, length, 10)
    for i in range(3):
        n, s = int(length[i]), int(words[i])
        alone = net.encode_motion(motion[i : i + 1, :n], length[i : i + 1])
        torch.testing.assert_close(alone[0][0], mu[i], rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(alone[1][0], logvar[i], rtol=1e-5, atol=1e-5)
        text = net.encode_text(tokens[i : i + 1, :s], mask[i : i + 1, :s])
        torch.testing.assert_close(text[0][0], text_mu[i], rtol=1e-5, atol=1e-5)
        frames = net.decode(mu[i : i + 1], length[i : i + 1], n)
        torch.testing.assert_close(frames[0], decoded[i, :n], rtol=1e-5, atol=1e-5)
        assert (decoded[i, n:] == 0).all()


@pytest.mark.usefixtures("float64")
@torch.no_grad()
@pytest.mark.parametrize("stride", [2, 3])
def test_frame_stride_sees_every_nth_frame_only(stride: int) -> None:
    torch.manual_seed(0)
    net = Tma(TINY.model_copy(update={"frame_stride": stride}), 6, 5).eval()
    full = Tma(TINY, 6, 5).eval()
    full.load_state_dict(net.state_dict())
    motion, length = torch.randn(2, 11, 6), torch.tensor([11, 5])
    strided, frames = net.subsample(motion, length)
    assert frames.tolist() == [-(-11 // stride), -(-5 // stride)]
    torch.testing.assert_close(net.encode_motion(motion, length)[0], full.encode_motion(strided, frames)[0])
    z = torch.randn(2, 32)
    torch.testing.assert_close(net.decode(z, length, 11), full.decode(z, frames, strided.shape[1]))


def test_text_noise_is_as_wide_as_asked_and_of_each_caption() -> None:
    """Measured on many words: the width is a share of the caption's own size, whatever is masked."""
    torch.manual_seed(0)
    tokens = torch.randn(2, 400, 64) * torch.tensor([1.0, 5.0])[:, None, None]
    mask = torch.arange(400)[None] < torch.tensor([400, 200])[:, None]
    tokens[1, 200:] = 1e6  # masked: plays no part in the size
    added = noisy(tokens, mask, 0.5)[mask] - tokens[mask]
    first, second = added[:400], added[400:]
    # 25,600 and 12,800 draws: the deviation is within 4 standard errors, 4 / sqrt(2 * 12,800) = 2.5 %.
    assert first.std().item() == pytest.approx(0.5, rel=0.03)
    assert second.std().item() == pytest.approx(2.5, rel=0.03)
    assert abs(first.mean().item()) < 4 * 0.5 / 160


def test_text_noise_is_for_training_alone_and_off_draws_nothing() -> None:
    tokens, mask = torch.randn(3, 7, 5), torch.ones(3, 7, dtype=torch.bool)
    torch.manual_seed(0)
    net, plain = Tma(TINY.model_copy(update={"text_noise": 0.5}), 6, 5), Tma(TINY, 6, 5)
    plain.load_state_dict(net.state_dict())
    with torch.no_grad():
        assert torch.equal(net.eval().encode_text(tokens, mask)[0], plain.eval().encode_text(tokens, mask)[0])
        before = torch.get_rng_state()
        off = plain.train().encode_text(tokens, mask)[0]
        assert torch.equal(before, torch.get_rng_state())
        net.train()
        torch.manual_seed(1)
        once = net.encode_text(tokens, mask)[0]
        torch.manual_seed(1)
        again = net.encode_text(tokens, mask)[0]
    assert torch.equal(once, again)
    assert not torch.allclose(once, off)


def test_text_dropout_is_the_text_encoders_alone() -> None:
    """Nothing else of the network changes, also not the draws it is made with."""
    config = TINY.model_copy(update={"dropout": 0.1})
    torch.manual_seed(0)
    plain = Tma(config, 6, 5)
    torch.manual_seed(0)
    more = Tma(config.model_copy(update={"text_dropout": 0.4}), 6, 5)
    for (name, one), (_, other) in zip(plain.state_dict().items(), more.state_dict().items(), strict=True):
        assert torch.equal(one, other), name

    def rates(part: torch.nn.Module) -> set[float]:
        return {m.p for m in part.modules() if isinstance(m, torch.nn.Dropout)}

    assert rates(plain.text_encoder) == rates(plain.motion_encoder) == {0.1}
    assert rates(more.text_encoder) == {0.4}
    assert rates(more.motion_encoder) == rates(more.motion_decoder) == {0.1}


# TMA's loss terms against golden vectors of TMR/OpenTMA, slow references, and two-process runs.


@pytest.fixture(scope="module")
def golden(shared: Path) -> dict[str, torch.Tensor]:
    with np.load(shared / "golden" / "t8_tma_losses_A.npz", allow_pickle=False) as data:
        return {key: torch.from_numpy(np.asarray(data[key])) for key in data.files}


def close(value: torch.Tensor, expected: torch.Tensor, rtol: float = 1e-5, atol: float = 1e-6) -> None:
    torch.testing.assert_close(value.double(), expected.double(), rtol=rtol, atol=atol)


@pytest.mark.parametrize("temperature", [0.1, 0.7])
@pytest.mark.parametrize("threshold", [None, 0.8, 0.9])
def test_info_nce_equals_tmr(
    golden: dict[str, torch.Tensor], temperature: float, threshold: float | None
) -> None:
    """TMR drops a pair above cosine 2 * threshold - 1; ours takes the cosine itself."""
    name = f"tmr_infonce_t{temperature}_thr{threshold}"
    text = golden["text"].clone().requires_grad_()
    loss = info_nce(
        text,
        golden["motion"],
        None if threshold is None else golden["sent_emb"],
        temperature=temperature,
        threshold=0.0 if threshold is None else 2 * threshold - 1,
    )
    close(loss, golden[name])
    if f"{name}_grad_text" in golden:
        loss.backward()
        close(text.grad, golden[f"{name}_grad_text"])


def test_info_nce_equals_opentma_where_its_duplicates_round_below_one(
    golden: dict[str, torch.Tensor],
) -> None:
    text, motion, sentence = golden["text"], golden["motion"], golden["sent_emb"]
    close(info_nce(text, motion), golden["opentma_infonce_t0.1_nofilter"])
    assert golden["n_filtered"][3] == 0  # in this file OpenTMA's rule and ours select the same pairs
    assert false_negatives(sentence, 0.85).sum() == golden["n_filtered"][2]
    close(info_nce(text, motion, sentence), golden["opentma_infonce_t0.1_filter085"])


def test_without_a_threshold_every_pair_is_a_negative() -> None:
    """A threshold of 1 would still leave out duplicates whose cosine rounds to more than 1."""
    torch.manual_seed(0)
    text, motion = torch.randn(8, 5), torch.randn(8, 5)
    sentence = torch.randn(1, 384).expand(8, -1) * torch.rand(8, 1)
    close(info_nce(text, motion, sentence, threshold=None), info_nce(text, motion))
    close(info_nce(text, motion, sentence), torch.tensor(0.0))  # all captions are one


def test_exact_duplicates_are_filtered_and_the_diagonal_never(golden: dict[str, torch.Tensor]) -> None:
    sentence = torch.eye(6)[[0, 1, 1, 2, 1, 3]]  # cosine exactly 1.0 in float32: OpenTMA would keep these
    same = false_negatives(sentence, 0.85)
    expected = torch.zeros(6, 6, dtype=torch.bool)
    for i in (1, 2, 4):
        for j in (1, 2, 4):
            expected[i, j] = i != j
    assert torch.equal(same, expected)
    text, motion = golden["text"][:6], golden["motion"][:6]
    a, b = F.normalize(text, dim=-1), F.normalize(motion, dim=-1)
    logits = (a @ b.T / 0.1).double()
    total = 0.0
    for i in range(6):
        rows = [j for j in range(6) if not expected[i, j]]
        total += torch.logsumexp(logits[i, rows], 0).item() + torch.logsumexp(logits[rows, i], 0).item()
        total -= 2 * logits[i, i].item()
    assert info_nce(text, motion, sentence).item() == pytest.approx(total / 12, rel=1e-5)


def test_kl_and_latent_terms_equal_tmr(golden: dict[str, torch.Tensor]) -> None:
    q, p = (golden["mu_q"], golden["logvar_q"]), (golden["mu_p"], golden["logvar_p"])
    zero = torch.zeros_like(q[0])
    close(kl_divergence(*q, *p), golden["kl_qp"])
    close(kl_divergence(*p, *q), golden["kl_pq"])
    close(kl_divergence(*q, zero, zero), golden["kl_q0"])
    close(kl_divergence(*p, zero, zero), golden["kl_p0"])
    close(kl_divergence(*q, *p), golden["kl_qp_opentma"])
    close(kl_four(q, p), golden["tmr_total_kl"])
    close(latent_loss(golden["text"], golden["motion"]), golden["tmr_total_latent"])


def test_totals_equal_tmr_and_opentma(golden: dict[str, torch.Tensor]) -> None:
    g = golden
    mask = torch.ones(g["ref_motion"].shape[:2], dtype=torch.bool)
    rec_text = reconstruction_loss(g["rec_from_text"], g["ref_motion"], mask)
    rec_motion = reconstruction_loss(g["rec_from_motion"], g["ref_motion"], mask)
    close(rec_text, g["opentma_recons_text2jfeats_part"])
    close(rec_motion, g["opentma_recons_jfeats2jfeats_part"])
    close(rec_text + rec_motion, g["tmr_total_recons"])
    q, p = (g["mu_q"], g["logvar_q"]), (g["mu_p"], g["logvar_p"])
    shared_terms = rec_text + rec_motion + 1e-5 * latent_loss(g["text"], g["motion"])
    contrast = info_nce(g["text"], g["motion"], g["sent_emb"], threshold=0.6)
    close(contrast, g["tmr_total_contrastive"])
    close(shared_terms + 1e-5 * kl_four(q, p) + 0.1 * contrast, g["tmr_total_loss"])
    # OpenTMA contrasts the means and has only the two cross KL terms; the part it lacks is added here.
    means = info_nce(g["mu_q"], g["mu_p"], g["sent_emb"])
    close(means, g["opentma_contrastive_infonce_part"])
    missing = 1e-5 * (g["kl_q0"] + g["kl_p0"])
    close(shared_terms + 1e-5 * kl_four(q, p) + 0.1 * means, g["opentma_total"] + missing)


@settings(max_examples=20, deadline=None)
@given(lengths=st.lists(st.integers(1, 9), min_size=1, max_size=5), seed=st.integers(0, 99))
def test_masked_reconstruction_equals_frame_by_frame(lengths: list[int], seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    pred = torch.randn(len(lengths), 9, 3, generator=generator)
    target = 2 * torch.randn(len(lengths), 9, 3, generator=generator)
    mask = torch.arange(9)[None] < torch.tensor(lengths)[:, None]
    real = [F.smooth_l1_loss(pred[i, :n], target[i, :n], reduction="sum") for i, n in enumerate(lengths)]
    expected = torch.stack(real).sum() / (3 * sum(lengths))
    target[~mask] = torch.nan  # padding must not leak, whatever it holds
    close(reconstruction_loss(pred, target, mask), expected)
