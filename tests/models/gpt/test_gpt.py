"""The GPT's network and losses: grammar, corruption, alignment, hand-over."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from toy_gpt import PATTERN, STREAMS, TINY, aligned_gpt, random_codes, sequences, toy_gpt

from motionloom.datasets.base.errors import UserError
from motionloom.models.gpt.losses import corrupt, cross_entropy, soft_codes, straight_through
from motionloom.models.gpt.module import GptModule
from motionloom.models.gpt.network import InterleavedGPT
from motionloom.models.gpt.tokens import PAD
from motionloom.models.tma.losses import info_nce
from motionloom.models.tma.network import Tma, TmaConfig
from motionloom.models.tokenizer.base import Stream
from motionloom.models.training import compiled
from motionloom.models.training.stage_module import OptimConfig


@pytest.fixture
def gpt() -> InterleavedGPT:
    return toy_gpt().eval()


@torch.no_grad()
def test_only_legal_tokens_have_logits(gpt: InterleavedGPT) -> None:
    seq, text = sequences([2, 3], gpt)
    logits = gpt(seq.tokens, seq.kinds, text)
    assert logits.shape == (2, 11, 8)
    legal = torch.isfinite(logits)
    body, body_or_end = {*range(7)}, {*range(8)}
    hand = {*range(5)}
    group = [body_or_end, body, hand]
    expected = [[*group * 2, body_or_end, {5}], [*group * 3, body_or_end, {5}]]
    for row, sets in enumerate(expected):
        for position, allowed in enumerate(sets):
            assert set(legal[row, position].nonzero()[:, 0].tolist()) == allowed, (row, position)


@pytest.mark.usefixtures("float64")
@torch.no_grad()
def test_causal_and_conditional(gpt: InterleavedGPT) -> None:
    seq, text = sequences([4], gpt)
    text = text.double()
    full = gpt(seq.tokens, seq.kinds, text)
    other = seq.tokens.clone()
    other[0, 6] = (other[0, 6] + 1) % 7
    changed = gpt(other, seq.kinds, text)
    torch.testing.assert_close(changed[:, :7], full[:, :7])
    finite = torch.isfinite(full)
    assert (changed[finite] - full[finite]).abs()[:].max() > 1e-4
    moved = gpt(seq.tokens, seq.kinds, text + 1)
    assert (moved[0, 0] - full[0, 0])[:7].abs().max() > 1e-4
    null = gpt(seq.tokens, seq.kinds, text, drop_text=torch.tensor([True]))
    null_other = gpt(seq.tokens, seq.kinds, text + 1, drop_text=torch.tensor([True]))
    torch.testing.assert_close(null, null_other)


def test_corruption_stays_in_the_stream(gpt: InterleavedGPT) -> None:
    seq, _ = sequences([8] * 200, gpt)
    ends = torch.tensor([7, 5])
    torch.manual_seed(0)
    out = corrupt(seq.tokens, seq.kinds, ends, 0.5)
    code = (seq.tokens != PAD) & (seq.tokens != ends[seq.kinds])
    assert torch.equal(out[~code], seq.tokens[~code])
    assert (out[code] < ends[seq.kinds][code]).all()
    assert (out[code] >= 0).all()
    for kind, size in enumerate((7, 5)):
        here = code & (seq.kinds == kind)
        assert set(out[here].tolist()) == set(range(size))
        # Half are redrawn, and a redraw hits the old code once in `size`.
        changed = (out[here] != seq.tokens[here]).float().mean().item()
        assert changed == pytest.approx(0.5 * (1 - 1 / size), abs=0.04)
    assert torch.equal(corrupt(seq.tokens, seq.kinds, ends, 1.0), seq.tokens)


def test_too_long_and_unknown_streams_are_refused(gpt: InterleavedGPT) -> None:
    seq, text = sequences([10], gpt)
    with pytest.raises(UserError, match="block_size 30"):
        gpt(seq.tokens, seq.kinds, text)
    with pytest.raises(UserError, match="names \\['face'\\]"):
        InterleavedGPT(TINY, STREAMS, ("body", "face"), 6)


def align_module(**loss: float) -> tuple[GptModule, dict[str, Tensor]]:
    module, _, _ = aligned_gpt(loss=loss)
    sequence, text = sequences([5, 2, 3, 4], module.net)
    return module, {**sequence._asdict(), "text": text, "similarity": torch.eye(4)}


def test_alignment_reaches_every_code_head_from_its_step_on() -> None:
    """With the cross-entropy left out, the gradient of L_align alone moves both heads and both codebooks'
    embeddings.
    """
    module, batch = align_module(align_from=2)
    module.step = 1
    assert "align" not in module.losses(batch)
    module.step = 2
    values = module.losses(batch)
    assert values["loss"].item() == pytest.approx(
        values["ce"].item() + 0.1 * values["align"].item(), rel=1e-5
    )
    values["align"].backward()
    for head in module.net.heads:
        gradient = head.weight.grad
        assert torch.isfinite(gradient).all()
        assert gradient[:-1].abs().max() > 0
        assert gradient[-1].abs().max() == 0  # End is no part of the decoded motion
    assert module.net.text_in.weight.grad.abs().max() > 0


@pytest.mark.parametrize("sample", [False, True])
def test_weights_are_one_code_with_the_gradient_of_the_softmax(sample: bool) -> None:
    """However flat the distribution is; draws follow it."""
    logits = torch.linspace(-1, 1, 5).expand(20_000, 5).requires_grad_()
    torch.manual_seed(0)
    weights = straight_through(logits, 0.7, sample=sample)
    torch.testing.assert_close(weights.sort().values, torch.eye(5)[4].expand(20_000, 5))
    share = weights.mean(0) if sample else torch.tensor([0.0, 0, 0, 0, 1])
    torch.testing.assert_close(share, logits[0].softmax(-1) if sample else share, rtol=0, atol=0.02)
    (slope,) = torch.autograd.grad(weights[:, 2].sum(), logits)
    assert slope.sum(-1).abs().max() < 1e-6 and (slope[:, 2] > 0).all()


def test_a_lost_network_has_no_loss_of_zero() -> None:
    tokens = torch.tensor([[1, 2, -1]])
    logits = torch.full((1, 3, 4), torch.nan)
    assert cross_entropy(logits, tokens).isnan()


def test_alignment_on_known_logits_decodes_the_codes() -> None:
    module, batch = align_module()
    net = module.net
    logits = torch.full((4, batch["tokens"].shape[1], net.vocabulary), -50.0)
    logits.scatter_(2, batch["tokens"].clamp(min=0)[..., None], 50.0)
    groups = torch.tensor([5, 2, 3, 4])
    for sample in (True, False):
        weights = soft_codes(net, logits, groups, temperature=1.0, sample=sample)
        for kind, name in enumerate(net.names):
            for row in range(4):
                real = batch["tokens"][row, : 3 * groups[row]]
                mine = real[batch["kinds"][row, : 3 * groups[row]] == kind]
                assert torch.equal(weights[name][row, : len(mine)].argmax(-1), mine)
            torch.testing.assert_close(weights[name].sum(-1), torch.ones(weights[name].shape[:2]))
    tokenizer = module.tokenizer.module
    codes = {name: w.argmax(-1) for name, w in weights.items()}
    torch.testing.assert_close(
        tokenizer.decode_soft(weights, 4 * groups), tokenizer.decode(codes, 4 * groups), rtol=1e-4, atol=1e-5
    )


@pytest.mark.slow
@pytest.mark.parametrize(("weight", "steps"), [(0.1, 300), (1.0, 1000)])
def test_alignment_and_cross_entropy_find_the_answer_that_both_have(weight: float, steps: int) -> None:
    """TMA knows the eight clips, so their codes are the best for both terms: the weight costs steps alone."""
    module, tokenizer, tma = aligned_gpt(loss={"align_weight": weight})
    net = module.net
    groups = [5, 2, 3, 4, 6, 5, 4, 3]
    codes = random_codes(groups, [Stream(s, net.num_codes[s], net.pattern.count(s)) for s in net.names])
    text = torch.randn(8, 16, generator=torch.Generator().manual_seed(5))
    batch = {**sequences(groups, net)[0]._asdict(), "text": text, "similarity": torch.eye(8)}
    frames = codes.groups * tokenizer.group_frames
    motion = tokenizer.decode(codes.codes, frames).detach()
    optimizer = torch.optim.Adam(tma.requires_grad_().parameters(), lr=2e-3)
    for _ in range(300):
        optimizer.zero_grad()
        info_nce(text, tma.encode_motion(motion, frames)[0], None, temperature=0.1, threshold=None).backward()
        optimizer.step()
    tma.requires_grad_(False)
    optimizer = torch.optim.Adam(net.parameters(), lr=3e-3)
    module.train()
    torch.manual_seed(0)
    for _ in range(steps):
        optimizer.zero_grad()
        values = module.losses(batch)
        values["loss"].backward()
        optimizer.step()
    assert values["ce"] < 0.15 and values["align"] < 0.15, "2.2 and 4.7 at first"


def test_alignment_teaches_nothing_where_the_text_was_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    module, batch = align_module()
    module.net.config = TINY.model_copy(update={"condition_dropout": 0.5})
    seen: dict[str, torch.Tensor] = {}
    forward = module.net.forward

    def watched(*args: torch.Tensor, **named: torch.Tensor) -> torch.Tensor:
        logits = forward(*args, **named)
        logits.retain_grad()
        seen.update(logits=logits, dropped=named["drop_text"])
        return logits

    monkeypatch.setattr(module.net, "forward", watched)
    module.train()
    torch.manual_seed(1)
    module.losses(batch)["align"].backward()
    moved = seen["logits"].grad.abs().sum((1, 2)) > 0
    assert torch.equal(moved, ~seen["dropped"])
    assert 0 < moved.sum() < len(moved), "both kinds are in the batch"


def test_every_parameter_gets_a_gradient() -> None:
    """DDP waits for all of them: the null text too, when no sample happens to lose its text."""
    module, batch = align_module(align_weight=0.0)
    assert module.tokenizer is None
    values = module.losses(batch)
    assert set(values) == {"loss", "ce", "accuracy_body", "accuracy_hand"}
    values["loss"].backward()
    assert [name for name, p in module.net.named_parameters() if p.grad is None] == []


def test_hand_over_is_checked() -> None:
    module, batch = align_module()
    tokenizer, tma = module.tokenizer.module, module.tma.module
    keywords = {"seed": 0, "max_steps": 1}
    with pytest.raises(UserError, match="trained tokenizer"):
        GptModule(module.net, OptimConfig(), **keywords)
    with pytest.raises(UserError, match="not the tokenizer's"):
        wrong = InterleavedGPT(TINY, STREAMS, PATTERN, 16)
        GptModule(wrong, OptimConfig(), tokenizer=tokenizer, tma=tma, **keywords)
    with pytest.raises(UserError, match=r"313 columns.* 133"):
        small = Tma(TmaConfig(latent=16, ff=32, layers=1, heads=2), 133, 10)
        GptModule(module.net, OptimConfig(), tokenizer=tokenizer, tma=small, **keywords)
    wide = {**batch, "text": torch.randn(4, 16), "tma_text": torch.randn(4, 12)}
    with pytest.raises(UserError, match="width 16"):
        module.losses(wide)


def test_sequences_filled_up_for_cuda_graphs_have_the_same_losses() -> None:
    """Of all lengths ten are left, each of which is one graph."""
    module = aligned_gpt(block_size=150)[0].double().eval()
    seq, text = sequences([8, 5], module.net)
    batch = {"tokens": seq.tokens, "kinds": seq.kinds, "text": text.double(), "known": seq.tokens >= 0}
    filled = compiled._pad_tokens(batch, module.net)
    assert isinstance(filled, dict) and filled["tokens"].shape == filled["known"].shape == (2, 32)
    torch.testing.assert_close(module.losses(filled), module.losses(batch))
    sizes = [compiled._pad_tokens({"tokens": torch.zeros(1, n)}, module.net) for n in range(1, 151)]
    assert len({one["tokens"].shape for one in sizes if isinstance(one, dict)}) == 10


def test_every_clip_may_count_alike() -> None:
    """T2M-GPT's public code: the mean over clips of each clip's mean, here of three tokens and of one."""
    logits = torch.randn(2, 3, 5)
    tokens = torch.tensor([[1, 2, 3], [4, PAD, PAD]])
    rows = [
        torch.nn.functional.cross_entropy(some, known[known != PAD])
        for some, known in ((logits[0], tokens[0]), (logits[1, :1], tokens[1]))
    ]
    assert torch.allclose(cross_entropy(logits, tokens, per_clip=True), torch.stack(rows).mean())
