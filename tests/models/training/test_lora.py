"""LoRA adapters: nothing changes at first, only they learn, and merged they are plain weights."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from motionloom.datasets.schema import UserError
from motionloom.models.gpt.network import GptConfig, InterleavedGPT
from motionloom.models.tokenizer.base import Stream
from motionloom.models.training.lora import LoraConfig, add_lora, merge_lora, trained_share

pytest.importorskip("peft", reason="peft is not installed (the extra `lora`)")

PATTERN = ("body", "body", "hand")


def network() -> InterleavedGPT:
    torch.manual_seed(1)
    config = GptConfig(layers=2, dim=24, heads=3, ff=40, dropout=0.0, attention_dropout=0.0, block_size=20)
    return InterleavedGPT(config, (Stream("body", 11, 2), Stream("hand", 7, 1)), PATTERN, 6).double()


def inputs() -> tuple[Tensor, Tensor, Tensor]:
    """Tokens, kinds and text of two sequences."""
    draw = torch.Generator().manual_seed(2)
    kinds = torch.tensor([0, 0, 1] * 4).expand(2, -1)
    tokens = torch.randint(0, 7, (2, 12), generator=draw)
    return tokens, kinds, torch.randn(2, 6, generator=draw, dtype=torch.float64)


def learn(net: InterleavedGPT, steps: int = 3) -> None:
    """A few steps of plain gradient descent on the tokens."""
    tokens, kinds, text = inputs()
    moved = [p for p in net.parameters() if p.requires_grad]
    for _ in range(steps):
        chosen = net(tokens, kinds, text).log_softmax(-1).gather(-1, tokens[..., None])
        for parameter, slope in zip(moved, torch.autograd.grad(-chosen.mean(), moved), strict=True):
            parameter.data -= 0.5 * slope


def test_merged_weights_give_what_the_adapters_gave() -> None:
    """And W + (alpha / rank) B A is what they are."""
    net = network()
    names = list(net.state_dict())
    before = net.stack.blocks[1].ff_in.weight.clone()
    start = net(*inputs())
    add_lora(net, LoraConfig(rank=4, alpha=6))
    assert torch.equal(net(*inputs()), start), "nothing changes at first"
    learn(net)
    adapted = net(*inputs())
    finite = start.isfinite()
    assert (adapted - start)[finite].abs().max() > 1e-3
    layer = net.stack.blocks[1].ff_in
    a, b = layer.lora_A["default"].weight.clone(), layer.lora_B["default"].weight.clone()
    merge_lora(net)
    torch.testing.assert_close(net(*inputs()), adapted, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(net.stack.blocks[1].ff_in.weight, before + 1.5 * b @ a, rtol=1e-12, atol=1e-14)
    assert list(net.state_dict()) == names
    assert all(type(m) is torch.nn.Linear for m in (net.stack.blocks[0].attention.qkv, layer.base_layer))


def test_only_adapters_and_what_is_whole_learn() -> None:
    net = network()
    before = {name: value.clone() for name, value in net.state_dict().items()}
    add_lora(net, LoraConfig(rank=4, whole=("text_in",)))
    trained = {name for name, p in net.named_parameters() if p.requires_grad}
    assert trained == {n for n, _ in net.named_parameters() if "lora_" in n or n.startswith("text_in.")}
    # rank * (in + out) of qkv, out, ff_in and ff_out in two blocks, and text_in's 6 * 24 + 24
    per_block = 4 * ((24 + 72) + (24 + 24) + (24 + 40) + (40 + 24))
    assert trained_share(net)[0] == 2 * per_block + 168
    learn(net)
    for name, value in net.state_dict().items():
        plain = name.replace(".base_layer", "")
        if plain in before and not plain.startswith("text_in."):
            assert torch.equal(value, before[plain]), name
    assert not torch.equal(net.text_in.weight, before["text_in.weight"])


def test_names_that_no_layer_has_are_refused() -> None:
    with pytest.raises(UserError, match="'key'"):
        add_lora(network(), LoraConfig(layers=("key",)))
    with pytest.raises(UserError, match=r"lora.whole: .*'body'.* embeddings"):
        add_lora(network(), LoraConfig(whole=("body",)))
