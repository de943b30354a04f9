"""TM2T's captioner and its text to motion: words, search and losses."""

from __future__ import annotations

from itertools import product

import pytest
import torch
from torch import Tensor
from toy_gpt import PATTERN, STREAMS, closed

from motionloom.models.gpt.rows import Drawing
from motionloom.models.gpt.tokens import interleave
from motionloom.models.training.stage_module import OptimConfig
from motionloom.pipeline.baselines.tm2t.generator import likeliest
from motionloom.pipeline.baselines.tm2t.module import CaptionerModule, Seq2SeqModule, summed_or_mean
from motionloom.pipeline.baselines.tm2t.network import (
    END,
    FIRST,
    PAD,
    START,
    UNKNOWN,
    Captioner,
    CaptionerConfig,
    CaptionLossConfig,
    Seq2SeqLossConfig,
    Vocabulary,
    hidden_ends,
)
from motionloom.pipeline.baselines.tm2t.seq2seq import Seq2Seq, Seq2SeqConfig, draw_tokens

TINY = CaptionerConfig(
    layers=1, dim=16, heads=2, ff=32, dropout=0.0, attention_dropout=0.0, block_size=30, max_words=3
)


def tiny(words: int = 7) -> Captioner:
    torch.manual_seed(0)
    net = Captioner(TINY, STREAMS, PATTERN, words)
    with torch.no_grad():
        net.word_table.weight.mul_(2)  # peaked distributions, in which a mix-up shows
    return net.eval()


def test_words_and_their_numbers() -> None:
    said = ["A person walks.", "a person walks", "the man's T-pose, twice", "a MAN runs"]
    found = Vocabulary.of(said, most=4, least_uses=1)
    assert found.words == ("a", "person", "walks", "man") and len(found) == FIRST + 4
    assert Vocabulary.of(said, most=9, least_uses=2).words == ("a", "person", "walks")
    numbers = found.encode(["a man jumps", "", "a a a a"], longest=3)
    a, man = FIRST, FIRST + 3
    assert numbers.tolist() == [[a, man, UNKNOWN, END], [END, PAD, PAD, PAD], [a, a, a, END]]
    assert found.decode([a, man]) == "a man"


@torch.no_grad()
def test_the_search_finds_what_trying_all_sentences_finds() -> None:
    """Three words at most, of three: 39 sentences; probabilities are those of the words one by one."""
    net = tiny()
    tokens, kinds, _ = closed([4, 2])
    found = likeliest(net, net.begin(net.embedded(tokens, kinds), tokens >= 0), 5, 30)
    for row in range(2):
        every = []
        for count in (1, 2, 3):
            for words in product(range(FIRST, 7), repeat=count):
                numbers = torch.tensor([[*words, END]])
                own = tokens[row : row + 1], kinds[row : row + 1]
                logits = net(*own, numbers, own[0] >= 0)[0].double()
                logits[:, [PAD, START, UNKNOWN]] = -torch.inf
                each = logits.log_softmax(-1).gather(1, numbers.t())
                every.append((float(each.sum()), words))
        best = sorted(every, reverse=True)[:5]
        assert [one.words for one in found[row]] == [words for _, words in best]
        assert [one.log_probability for one in found[row]] == pytest.approx([s for s, _ in best], abs=1e-4)


@torch.no_grad()
def test_neither_padding_nor_what_is_hidden_or_lacks_plays_a_part() -> None:
    net = tiny()
    tokens, kinds, _ = closed([4, 2])
    words, known = torch.tensor([[4, 5, END, PAD], [6, END, PAD, PAD]]), kinds == 0
    both = net(tokens, kinds, words, tokens >= 0, known)
    alone = net(tokens[1:, :8], kinds[1:, :8], words[1:, :2], tokens[1:, :8] >= 0, known[1:, :8])
    torch.testing.assert_close(both[1:, :2], alone)
    other = torch.where(known | (tokens == 5), tokens, (tokens + 1) % 5)
    torch.testing.assert_close(net(other, kinds, words, tokens >= 0, known), both)
    later = words.clone()
    later[0, 1] = 6
    torch.testing.assert_close(net(tokens, kinds, later, tokens >= 0, known)[0, :2], both[0, :2])
    torch.manual_seed(0)
    ends = hidden_ends(torch.tensor([4, 3, 1]).repeat(200), 14, 3, 1.0).view(200, 3, 14)
    assert not ends[:, 2].any() and (ends[:, :2].sum(-1) == 3).all()
    assert {tuple(row.nonzero()[:, 0].tolist()) for row in ends[:, 1]} == {(0, 1, 2), (6, 7, 8)}


@pytest.mark.parametrize("summed", [False, True])
def test_the_loss_is_that_of_the_words_one_by_one(summed: bool) -> None:
    net = tiny()
    tokens, kinds, _ = closed([4, 2])
    words = torch.tensor([[4, 5, UNKNOWN, END], [6, END, PAD, PAD]])
    module = CaptionerModule(
        net, OptimConfig(), seed=0, max_steps=1, loss=CaptionLossConfig(summed=summed)
    ).eval()
    logits = net(tokens, kinds, words, tokens >= 0)
    logits = logits.detach()
    errors = [-logits[r, k].log_softmax(-1)[int(words[r, k])] for r, n in ((0, 4), (1, 2)) for k in range(n)]
    total = sum(float(error) for error in errors)
    got = module.losses({"tokens": tokens, "kinds": kinds, "text": words})
    assert float(got["loss"]) == pytest.approx(total if summed else total / 6, rel=1e-5)
    assert float(got["ce"]) == pytest.approx(total / 6, rel=1e-5)
    # A sum is the step's whole batch's, as the mean of its parts.
    module.train().accumulate = 2
    each, counted = torch.rand(4, 3), torch.rand(4, 3) < 0.7
    parts = [
        summed_or_mean(e, c, module, summed=True)
        for e, c in zip(each.split(2), counted.split(2), strict=True)
    ]
    torch.testing.assert_close(sum(parts) / 2, each[counted].sum())


GRU = Seq2SeqConfig(reader=6, dim=8, max_tokens=16)


def gru(text_dim: int = 5) -> Seq2Seq:
    torch.manual_seed(0)
    return Seq2Seq(GRU, STREAMS, PATTERN, text_dim)


def words_of_rows(count: int, text_dim: int = 5) -> tuple[Tensor, Tensor]:
    states = torch.randn(count, 4, text_dim, generator=torch.Generator().manual_seed(2))
    return states, torch.arange(4)[None] < torch.tensor([4, 2, 3, 1] * count)[:count, None]


@torch.no_grad()
def test_tokens_are_drawn_as_they_are_trained() -> None:
    """Greedy tokens are the likeliest codes of training's logits; rows depend on themselves alone."""
    net = gru()
    text, mask = words_of_rows(3)
    greedy = Drawing(temperature=0.0)
    codes = draw_tokens(net, text, mask, torch.tensor([4, 2, 3]), [0, 1, 2], greedy)
    made = interleave(codes.codes, PATTERN, groups=codes.groups)
    legal = torch.arange(8) < net.ends[made.kinds][..., None]
    logits = net.roll(
        text, mask, made.kinds, legal,
        lambda at, _: net.embed_at(made.tokens[:, at].clamp(min=0), made.kinds[:, at]),
    )  # fmt: skip
    inside = made.tokens >= 0
    assert torch.equal(logits.argmax(-1)[inside], made.tokens[inside])
    alone = draw_tokens(net, text[1:2, :2], mask[1:2, :2], torch.tensor([2]), [1], greedy)
    assert torch.equal(alone.codes["body"][0], codes.codes["body"][1, :4])
    free = draw_tokens(net, text, mask, None, [5, 6, 7], Drawing())
    assert ((free.groups >= 1) & (free.groups <= net.max_groups)).all()


def test_inverse_alignment_reaches_the_model_and_not_the_captioner() -> None:
    net, captioner = gru(), tiny()
    text, mask = words_of_rows(2)
    tokens, kinds, _ = closed([4, 2])
    said = torch.tensor([[4, 5, END], [6, END, PAD]])
    loss = Seq2SeqLossConfig(forced=(1, 1), inverse_weight=3.0)
    module = Seq2SeqModule(net, OptimConfig(), seed=0, max_steps=1, loss=loss, captioner=captioner).eval()
    batch = {"tokens": tokens, "kinds": kinds, "words": text, "mask": mask, "said": said}
    found = module.losses(batch)
    torch.testing.assert_close(found["loss"], found["ce"] + 3 * found["inverse"])
    # In validation the likeliest tokens are read: the captioner's error at them, End where the clip ends.
    groups = torch.tensor([4, 2])
    codes = draw_tokens(net, text, mask, groups, [0, 0], Drawing(temperature=0.0))
    made = interleave(codes.codes, PATTERN, ends=net.num_codes, groups=groups)
    logits = captioner(made.tokens, made.kinds, said, made.tokens >= 0).detach()
    errors = [-logits[r, k].log_softmax(-1)[int(said[r, k])] for r, n in ((0, 3), (1, 2)) for k in range(n)]
    assert float(found["inverse"]) == pytest.approx(float(torch.stack(errors).mean()), rel=1e-4)
    module.train().losses(batch)["inverse"].backward()
    assert net.text_in.weight.grad is not None and net.text_in.weight.grad.abs().max() > 0
    assert all(p.grad is None for p in captioner.parameters())


@torch.no_grad()
def test_words_are_read_as_torch_reads_them_both_ways() -> None:
    net, (text, mask) = gru(), words_of_rows(4)
    reference = torch.nn.GRU(6, 6, batch_first=True, bidirectional=True)
    own = net.reader.state_dict() | {f"{name}_reverse": v for name, v in net.back.state_dict().items()}
    reference.load_state_dict(own)
    read, state = net.read(text, mask)
    for row, count in enumerate(mask.sum(1).tolist()):
        states, last = reference(net.text_in(text[row, :count]), net.first[:, 0])
        torch.testing.assert_close(read.keys[row, :count], net.key(states))
        torch.testing.assert_close(state[row], net.begin(last.flatten()))
