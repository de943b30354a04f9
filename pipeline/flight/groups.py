"""Norms by layer group: each child of the network that a stage saves, and each other network it trains."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor


def group_of(name: str) -> str:
    """The layer group of a parameter of a stage's module: `encoder` of net.encoder.0.weight, `critic` of
    critic.2.bias, `net` of what the network has beside its children.
    """
    first, *rest = name.split(".")
    return rest[0] if first == "net" and len(rest) > 1 else first


class LayerGroups:
    """The layer groups of a module, in the order in which it has them."""

    def __init__(self, module: nn.Module) -> None:
        self._groups = {id(param): group_of(name) for name, param in module.named_parameters()}

    def gradient_norms(self, params: Iterable[nn.Parameter]) -> dict[str, Tensor]:
        """Norm of the gradients of each group among `params` that has any."""
        return self._norms((param, param.grad) for param in params)

    def weight_norms(self, params: Iterable[nn.Parameter]) -> dict[str, Tensor]:
        """Norm of the weights of each group among `params`."""
        return self._norms((param, param.detach()) for param in params)

    def _norms(self, pairs: Iterable[tuple[nn.Parameter, Tensor | None]]) -> dict[str, Tensor]:
        tensors: dict[str, list[Tensor]] = {}
        for param, tensor in pairs:
            if tensor is not None:
                tensors.setdefault(self._groups.get(id(param), "net"), []).append(tensor)
        return {name: whole(torch.nn.utils.get_total_norm(own)) for name, own in tensors.items()}


def whole(norm: Tensor) -> Tensor:
    """The norm of something that may be cut over ranks; then a collective."""
    return norm.full_tensor() if isinstance(norm, DTensor) else norm


def read_norms(norms: dict[str, Tensor]) -> dict[str, float]:
    """As plain numbers, in one transfer."""
    if not norms:
        return {}
    values: Sequence[float] = torch.stack([norm.float() for norm in norms.values()]).tolist()
    return dict(zip(norms, values, strict=True))
