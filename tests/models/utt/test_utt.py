"""The UTT: causality, padding, z, GRU, music beside its tokens."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from toy_gpt import PATTERN, STREAMS, closed, encoded

from motionloom.datasets.base.errors import UserError
from motionloom.models.condition.mate import Encoded
from motionloom.models.utt.network import Utt, UttConfig

TINY = UttConfig(layers=2, dim=16, heads=4, ff=32, block_size=30, dropout=0.0, attention_dropout=0.0, z_dim=3)


@pytest.fixture(params=["gpt", "gru"])
def utt(request: pytest.FixtureRequest) -> Utt:
    torch.manual_seed(0)
    net = Utt(TINY.model_copy(update={"kind": request.param}), STREAMS, PATTERN, glob_dim=6)
    for head in net.heads:
        torch.nn.init.normal_(head.weight, std=0.5)
    return net.double().eval()


def hidden(utt: Utt, tokens: Tensor, kinds: Tensor, condition: Encoded, z: Tensor | None = None) -> Tensor:
    """States in float64, of which `forward` gives float32 logits."""
    prefix, mask = utt.prefix(condition, z)
    embedded = utt.embed(tokens[:, :-1], kinds[:, :-1])
    return utt.backbone(prefix, mask, utt.motion_inputs(embedded, 0, utt.frame_condition(condition)))


def test_a_row_depends_on_nothing_but_itself(utt: Utt) -> None:
    tokens, kinds, _ = closed([5, 2, 3])
    condition, z = encoded(3, [5, 0, 2]), torch.randn(3, 3).double()
    condition = condition._replace(seq=condition.seq.masked_fill(~condition.mask[..., None], 1e3))
    together = hidden(utt, tokens, kinds, condition, z)
    for row, groups in enumerate([5, 2, 3]):
        size, real = 3 * groups + 2, int(condition.mask[row].sum())
        mine = condition.rows(slice(row, row + 1))
        mine = Encoded(mine.glob, mine.seq[:, :real], mine.mask[:, :real])
        alone = hidden(utt, tokens[row : row + 1, :size], kinds[row : row + 1, :size], mine, z[row : row + 1])
        torch.testing.assert_close(together[row, :size], alone[0], rtol=1e-10, atol=1e-10)


def test_motion_is_causal_and_sees_the_whole_prefix(utt: Utt) -> None:
    tokens, kinds, _ = closed([4])
    condition = encoded(1)
    condition.seq.requires_grad_()
    embedded = utt.embed(tokens[:, :-1], kinds[:, :-1]).detach().requires_grad_()
    prefix, mask = utt.prefix(condition)
    out = utt.backbone(prefix, mask, utt.motion_inputs(embedded, 0))
    for at in (0, 4, 13):
        seq_grad, grad = torch.autograd.grad(
            out[0, at].square().sum(), [condition.seq, embedded], retain_graph=True
        )
        assert (seq_grad[0].abs().sum(1) > 0).all()
        assert ((grad[0].abs().sum(1) > 0) == (torch.arange(13) < at)).all()


def test_z_is_added_to_the_global_embedding(utt: Utt) -> None:
    condition, z = encoded(2), torch.randn(2, 3).double()
    assert utt.z_in is not None
    moved = condition._replace(glob=condition.glob + utt.z_in(z))
    for a, b in zip(utt.prefix(condition, z), utt.prefix(moved), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)
    tokens, kinds, _ = closed([3, 3])
    plain, noisy = hidden(utt, tokens, kinds, condition), hidden(utt, tokens, kinds, condition, z)
    assert (plain - noisy).abs().amax(-1).min() > 1e-6
    still = Utt(TINY.model_copy(update={"z_dim": 0}), STREAMS, PATTERN, glob_dim=6)
    assert still.z_in is None
    with pytest.raises(UserError, match="z_dim 0"):
        still.prefix(encoded(2), z)


def test_music_beside_a_token_is_that_of_its_own_frames() -> None:
    torch.manual_seed(0)
    config = TINY.model_copy(update={"frame_condition": True})
    utt = Utt(config, STREAMS, PATTERN, glob_dim=6, stride=2).double().eval()
    tokens, kinds, _ = closed([4, 4])
    timed = torch.randn(2, 7, 6, dtype=torch.float64)  # three groups and a half: the last is padded
    condition = encoded(2)._replace(timed=timed)
    plain = hidden(utt, tokens, kinds, condition)
    for group in range(4):
        changed = timed.clone()
        changed[:, 2 * group] += 1.0
        found = hidden(utt, tokens, kinds, condition._replace(timed=changed))
        same = (found == plain).all(-1)
        # Input p predicts token p; a group has three of them, and two End tokens follow the last.
        assert same[:, : 3 * group].all()
        assert not same[:, 3 * group :].any()
    # Without music nothing is added, and the layer is in the graph nevertheless.
    none = hidden(utt, tokens, kinds, encoded(2))
    torch.testing.assert_close(
        none, hidden(utt, tokens, kinds, condition._replace(timed=torch.zeros_like(timed)))
    )
    utt(tokens, kinds, encoded(2)).masked_fill(~utt.legal(tokens, kinds), 0.0).sum().backward()
    assert utt.frame_condition_in is not None
    assert utt.frame_condition_in.weight.grad is not None


def test_logits_keep_the_grammar_and_codes_that_a_clip_lacks_are_read_as_zero(utt: Utt) -> None:
    tokens, kinds, _ = closed([4, 2])
    logits = utt(tokens, kinds, encoded(2))
    assert torch.equal(torch.isfinite(logits), utt.legal(tokens, kinds))
    tokens, kinds, _ = closed([4])
    known = kinds == 0
    other = torch.where(known, tokens, (tokens + 1) % 5)
    condition = encoded(1)
    a = utt(tokens, kinds, condition, inputs=tokens, known=known)
    b = utt(tokens, kinds, condition, inputs=other, known=known)
    assert torch.equal(a, b)
    assert not torch.equal(a, utt(tokens, kinds, condition, inputs=other))


def test_mistakes_are_named(utt: Utt) -> None:
    tokens, kinds, _ = closed([10])
    with pytest.raises(UserError, match=r"32 tokens.*net\.block_size 30"):
        utt(tokens, kinds, encoded(1))
    with pytest.raises(UserError, match="holds no motion"):
        Utt(TINY.model_copy(update={"block_size": 4}), STREAMS, PATTERN, 6)
    with pytest.raises(ValueError, match="built for width 6"):
        utt.prefix(Encoded(torch.zeros(1, 5), torch.zeros(1, 2, 5), torch.ones(1, 2) > 0))
