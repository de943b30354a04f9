"""Bailando's networks under the names of its release, re-packed as safetensors: codes; GPT and critic."""

from __future__ import annotations

from torch import nn

from motionloom.pipeline.baselines.bailando.codes import DanceVq
from motionloom.pipeline.baselines.bailando.network import CrossGpt
from motionloom.pipeline.store.weights import Joined, Release, Source

_BLOCK = {
    "attention.out": "attn.proj", "ff_in": "mlp.0", "ff_out": "mlp.2",
    "norm_attention": "ln1", "norm_ff": "ln2",
}  # fmt: skip
_RESIDUAL = {"spread": "model.1", "mix": "model.3"}


def release_of_codes(net: DanceVq) -> Release:
    """Return the published names of the network of `dance_vq`."""
    pairs = [(level, part) for level in range(net.config.halvings) for part in range(2)]
    out: dict[str, Source] = {}
    for half in net.halves:
        at = f"vqvae_{half}"
        out[f"{half}.quantizer.codebook"] = f"{at}.bottleneck.level_blocks.0.k"
        model = f"{at}.encoders.0.level_blocks.0.model"
        places = [*(f"{model}.{level}.{part}" for level, part in pairs), f"{model}.{net.config.halvings}"]
        out |= _convolutions(net, f"{half}.encoder", places)
    for ours, at in (("up.decoder", "vqvae_up.decoders"), ("down.decoder", "vqvae_down.decoders"),
                     ("root", "vqvae_down.decoders_root")):  # fmt: skip
        model = f"{at}.0.level_blocks.0.model"
        places = [f"{model}.0", *(f"{model}.{level + 1}.{part}" for level, part in pairs), f"{at}.0.out"]
        out |= _convolutions(net, ours, places)
    return Release(out)


def _convolutions(net: DanceVq, ours: str, places: list[str]) -> dict[str, Source]:
    """An encoder or decoder, each layer at its place: a convolution, or a stack of residual blocks."""
    out: dict[str, Source] = {}
    for name, _ in net.get_submodule(ours).named_parameters():
        layer, *block, kind = name.split(".")
        inner = f".model.{block[0]}.{_RESIDUAL[block[1]]}" if block else ""
        out[f"{ours}.{name}"] = f"{places[int(layer)]}{inner}.{kind}"
    return out


def release_of_gpt(net: nn.Module) -> Release:
    """Return the published names of a `CrossGpt` or an `ActorCritic`; a GPT alone reads no critic."""
    out: dict[str, Source] = {}
    for name, _ in net.named_parameters():
        place = name if name.startswith("critic.") else f"gpt.{name.removeprefix('gpt.')}"
        out[name] = _of_gpt(place)
    alone = isinstance(net, CrossGpt)
    return Release(out, unread=("*.attn.mask", *(("critic_net.*",) if alone else ())))


_STACKS = {"gpt.base": "gpt_base", "gpt.head": "gpt_head", "critic.stack": "critic_net"}
_AROUND = {
    "gpt.positions": "gpt_base.pos_emb",
    "gpt.codes.0.weight": "gpt_base.tok_emb_up.weight",
    "gpt.codes.1.weight": "gpt_base.tok_emb_down.weight",
    "gpt.music.weight": "gpt_base.cond_emb.weight",
    "gpt.music.bias": "gpt_base.cond_emb.bias",
    "gpt.out.0.weight": "gpt_head.head_up.weight",
    "gpt.out.1.weight": "gpt_head.head_down.weight",
    "critic.out.0.weight": "critic_net.head_up.weight",
    "critic.out.1.weight": "critic_net.head_down.weight",
}


def _of_gpt(name: str) -> Source:
    if name in _AROUND:
        return _AROUND[name]
    owner, stack, *inner, kind = name.split(".")
    there = _STACKS[f"{owner}.{stack}"]
    if inner == ["norm"]:
        return f"{there}.ln_f.{kind}"
    _, number, *part = inner
    at = f"{there}.blocks.{number}"
    if part[-1] == "qkv":
        return Joined(tuple(f"{at}.attn.{one}.{kind}" for one in ("query", "key", "value")))
    return f"{at}.{_BLOCK['.'.join(part)]}.{kind}"
