"""TMA's network and Lightning module: masks, strides, noise and dropout of the text."""

from __future__ import annotations

import pytest
import torch

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
