"""LoRA: a network goes on learning in small adapters, while the weights that it brings stay as they are.

Each adapted linear layer W x becomes W x + (alpha / rank) B A x with A [rank, in] and B [out, rank]; B starts
at zero, so training starts at exactly what the network was (Hu et al. 2021, section 4.1). The adapters are
those of `peft`. `merge_lora` adds them to W and leaves plain layers, so nothing behind the training knows of
them.
"""

from __future__ import annotations

from importlib.util import find_spec

from pydantic import Field
from torch import nn

from motionloom.datasets.schema import Config, UserError

LAYERS = ("attention.qkv", "attention.out", "ff_in", "ff_out")
"""Every linear layer of a transformer block [ours]: attention alone has less room for new motion."""

_NAME = "default"
"""peft's name of a layer's only adapter."""


class LoraConfig(Config):
    """Size of the adapters; all of it [ours]."""

    rank: int = Field(16, ge=1)
    """Width of an adapter."""
    alpha: int = Field(32, ge=1)
    """An adapter's output is multiplied by this over `rank`."""
    dropout: float = Field(0.0, ge=0, lt=1)
    """Dropout of an adapter's input."""
    layers: tuple[str, ...] = Field(LAYERS, min_length=1)
    """Ends of the names of the linear layers that are adapted."""
    whole: tuple[str, ...] = ()
    """Modules trained in full beside the adapters, by the first word of their names: `text_in`, `embeddings`,
    `heads`."""


def require_peft() -> None:
    """A sentence where peft is not installed."""
    if find_spec("peft") is None:
        raise UserError(
            "lora needs the package peft: pip install 'motionloom[lora]'; or train the whole network, with "
            "lora: null"
        )


def add_lora(net: nn.Module, config: LoraConfig) -> None:
    """Adapt `net` in place; of its parameters only the adapters, and what is `whole`, have gradients."""
    require_peft()
    from peft import LoraConfig as PeftConfig
    from peft import inject_adapter_in_model

    names = [name for name, layer in net.named_modules() if isinstance(layer, nn.Linear)]
    for end in config.layers:
        if not any(name == end or name.endswith(f".{end}") for name in names):
            raise UserError(f"lora.layers: no linear layer of this network is called '{end}'")
    parts = {name.split(".")[0] for name, _ in net.named_parameters()}
    for part in config.whole:
        if part not in parts:
            raise UserError(f"lora.whole: this network has no '{part}'; it has {', '.join(sorted(parts))}")
    adapters = PeftConfig(
        r=config.rank,
        lora_alpha=config.alpha,
        lora_dropout=config.dropout,
        target_modules=list(config.layers),
        bias="none",
    )
    inject_adapter_in_model(adapters, net, adapter_name=_NAME)
    for name, parameter in net.named_parameters():
        parameter.requires_grad_("lora_" in name or name.split(".")[0] in config.whole)


def merge_lora(net: nn.Module) -> None:
    """Add the adapters of `net` to the layers that they adapt, which are plain ones again; in place."""
    from peft.tuners.lora import LoraLayer

    for name, layer in list(net.named_modules()):
        if isinstance(layer, LoraLayer):
            layer.merge()
            above, _, own = name.rpartition(".")
            setattr(net.get_submodule(above), own, layer.get_base_layer())
    net.requires_grad_(True)


def trained_share(net: nn.Module) -> tuple[int, int]:
    """Numbers of the parameters that have gradients, and of all."""
    sizes = [(parameter.numel(), parameter.requires_grad) for parameter in net.parameters()]
    return sum(size for size, trained in sizes if trained), sum(size for size, _ in sizes)
