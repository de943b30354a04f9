"""The transformer beside torch's own, with LayerNorm before and behind, and step by step."""

from __future__ import annotations

import copy
import re
from typing import Any, get_args

import pytest
import torch
from torch import nn

from motionloom.models.diffusion.network import TextDenoiserConfig
from motionloom.models.layers.attention import unmasked_attention
from motionloom.models.layers.linear import Linear
from motionloom.models.layers.transformer import (
    Norm,
    SkipTransformer,
    Transformer,
    length_mask,
    name_in_torch,
)


def in_torch(net: Transformer, *, memory: bool) -> dict[str, torch.Tensor]:
    """Its weights by the names of torch's encoder, or decoder."""
    state = {}
    for name, value in net.state_dict().items():
        found = re.fullmatch(r"blocks\.(\d+)\.(.+)", name)
        own = found and f"layers.{found[1]}.{name_in_torch(found[2], memory=memory)}"
        state[own or name] = value
    return state


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("memory", [False, True])
@pytest.mark.parametrize("norm", get_args(Norm))
def test_equals_torchs(norm: Norm, memory: bool) -> None:
    torch.manual_seed(0)
    config = TextDenoiserConfig(dim=16, heads=4, ff=40, dropout=0)
    net = Transformer(config, 2, norm=norm, memory=memory).eval()
    for parameter in net.parameters():
        nn.init.normal_(parameter, std=0.3)
    x, mask = torch.randn(3, 9, 16), length_mask(torch.tensor([9, 5, 1]), 9)
    read, seen = torch.randn(3, 5, 16), length_mask(torch.tensor([2, 5, 1]), 5)
    sizes: dict[str, Any] = {"dropout": 0.0, "activation": "gelu", "batch_first": True}
    layer = (nn.TransformerDecoderLayer if memory else nn.TransformerEncoderLayer)(
        16, 4, 40, norm_first=norm == "pre", **sizes
    )
    last = nn.LayerNorm(16) if norm == "pre" else None
    own: nn.Module = (nn.TransformerDecoder if memory else nn.TransformerEncoder)(layer, 2, norm=last)  # type: ignore[operator]
    own.eval().load_state_dict(in_torch(net, memory=memory))
    if memory:
        found = net(x, mask, memory=read, memory_mask=seen)
        want = own(x, read, tgt_key_padding_mask=~mask, memory_key_padding_mask=~seen)
    else:
        found, want = net(x, mask), own(x, src_key_padding_mask=~mask)
    torch.testing.assert_close(found[mask], want[mask], rtol=1e-10, atol=1e-10)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("scale", [None, 1.0])
def test_keys_hidden_by_a_coordinate_equal_a_mask(scale: float | None) -> None:
    torch.manual_seed(0)
    query, key, value = (torch.randn(3, 2, size, 16).requires_grad_() for size in (5, 7, 7))
    seen = length_mask(torch.tensor([7, 4, 1]), 7)[:, None, None]
    mask = torch.zeros(seen.shape).masked_fill(~seen, -torch.inf)
    found = unmasked_attention(query, key, value, mask, 0.0, scale)
    want = nn.functional.scaled_dot_product_attention(query, key, value, mask, scale=scale)
    torch.testing.assert_close(found, want, rtol=1e-12, atol=1e-12)
    grads = [torch.autograd.grad(out.square().sum(), (query, key, value)) for out in (found, want)]
    torch.testing.assert_close(*grads, rtol=1e-12, atol=1e-12)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("sizes", [(313, 256), (256, 513), (3, 1), (16, 8)])
def test_a_product_filled_up_to_even_sizes_is_the_same(sizes: tuple[int, int]) -> None:
    layer, x = Linear(*sizes), torch.randn(2, 3, sizes[0])
    torch.testing.assert_close(layer.filled_up(x), layer(x), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("norm", get_args(Norm))
def test_step_by_step_equals_at_once(norm: Norm) -> None:
    torch.manual_seed(0)
    net = Transformer(TextDenoiserConfig(dim=16, heads=2, ff=32, dropout=0), 2, norm=norm).double().eval()
    x = torch.randn(2, 7, 16).double()
    cache = net.cache(7)
    with torch.no_grad():
        steps = torch.cat([net(part, causal=True, cache=cache) for part in x.split([1, 1, 3, 2], 1)], 1)
        torch.testing.assert_close(steps, net(x, causal=True), rtol=1e-10, atol=1e-10)


def test_checkpointed_activations_draw_again_what_they_drew() -> None:
    stack = Transformer(TextDenoiserConfig(dim=8, heads=2, ff=16, dropout=0.3), 2).double()
    x = torch.randn(3, 5, 8, dtype=torch.float64)
    grads = []
    for stack.checkpointed in (False, True):
        stack.zero_grad()
        torch.manual_seed(1)
        stack(x, torch.ones(3, 5, dtype=torch.bool)).square().sum().backward()
        grads.append([p.grad.clone() for p in stack.parameters() if p.grad is not None])
    for one, two in zip(*grads, strict=True):
        assert torch.equal(one, two)


@pytest.mark.usefixtures("float64")
def test_a_u_of_blocks_merges_what_the_first_half_made_last_one_first() -> None:
    net = SkipTransformer(TextDenoiserConfig(dim=8, heads=2, ff=16, dropout=0), 5, memory=True).eval()
    x, memory = torch.randn(2, 6, 8), torch.randn(2, 1, 8)
    mask = length_mask(torch.tensor([6, 3]), 6)
    a, b, c, d, e = (
        lambda y, block=block: block(y, mask[:, None, None], memory=memory) for block in net.blocks
    )
    first = a(x)
    second = b(first)
    fourth = d(net.merge[0](torch.cat([c(second), second], dim=-1)))
    fifth = e(net.merge[1](torch.cat([fourth, first], dim=-1)))
    torch.testing.assert_close(net(x, mask, memory=memory), net.norm(fifth))
    with pytest.raises(ValueError, match="odd"):
        SkipTransformer(TextDenoiserConfig(dim=8, heads=2, ff=16), 4)


def test_gradients_of_normalisation_are_added_up_in_float32() -> None:
    """Under autocast they are those of float64 up to the rounding of bfloat16."""

    def gradients(net: nn.Module, x: torch.Tensor) -> dict[str, torch.Tensor]:
        with torch.autocast("cpu", torch.bfloat16, enabled=x.dtype != torch.double, cache_enabled=False):
            out = net(x, mask)
        (out.double() * mask[..., None]).square().mean().backward()
        return {name: param.grad.double() for name, param in net.named_parameters() if param.grad is not None}

    torch.manual_seed(0)
    net = Transformer(TextDenoiserConfig(dim=32, heads=4, ff=64, dropout=0), 2, norm="post")
    x, mask = torch.randn(64, 48, 32), torch.arange(48) < torch.randint(8, 49, (64, 1))
    true = gradients(copy.deepcopy(net).double(), x.double())
    for name, found in gradients(net, x.bfloat16()).items():  # as a linear layer before gives it
        assert (found - true[name]).norm() < 0.05 * true[name].norm(), name
