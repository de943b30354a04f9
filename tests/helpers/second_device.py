"""A second device for machines without one: it computes on the CPU and refuses tensors of another device.

Within `second_device()`, whatever is put on `SECOND` is a `Far` tensor. As with a GPU, an operation on far
and near tensors together is an error (numbers, tensors of no dimension, and copies aside), and numpy takes
near tensors only. It shows that every tensor a network is given lies where the network lies. It does not
show what a GPU's own kernels do.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

SECOND = torch.device("maia", 0)
"""A device type that torch knows by name and this build has no kernels of."""

_COPIES = {"aten::copy_", "aten::_to_copy", "aten::to"}


class Far(torch.Tensor):
    """A tensor that says it is on `SECOND`; `near` holds its values."""

    near: torch.Tensor

    @staticmethod
    def __new__(cls, near: torch.Tensor) -> Far:
        made: Far = torch.Tensor._make_wrapper_subclass(
            cls, near.shape, strides=near.stride(), dtype=near.dtype, device=SECOND
        )
        made.near = near
        return made

    def tolist(self) -> Any:
        return self.near.tolist()

    # What follows asks, when it is called from Python, for a guard of the device, which does not exist.
    def __int__(self) -> int:
        return int(self.near)

    def __invert__(self) -> torch.Tensor:
        return torch.bitwise_not(self)

    # As with a GPU, an index may lie anywhere.
    def __getitem__(self, index: Any) -> Far:
        return Far(self.near[tree_map(_near, index)])

    def __setitem__(self, index: Any, value: Any) -> None:
        if isinstance(value, torch.Tensor) and value.dim() and not isinstance(value, Far):
            raise RuntimeError(f"expected all tensors on {SECOND}, found one on the CPU")
        self.near[tree_map(_near, index)] = _near(value)

    @classmethod
    def __torch_dispatch__(
        cls, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        return _run(func, args, dict(kwargs or {}))


class _Second(TorchDispatchMode):
    def __torch_dispatch__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        return _run(func, args, dict(kwargs or {}))


def _run(func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    values = tree_flatten((args, kwargs))[0]
    far = any(isinstance(value, Far) for value in values)
    copies = func._schema.name in _COPIES
    strange = [v for v in values if isinstance(v, torch.Tensor) and not isinstance(v, Far) and v.dim()]
    if far and strange and not copies:
        raise RuntimeError(f"{func}: expected all tensors on {SECOND}, found {strange[0].shape} on the CPU")
    for device in (value for value in values if isinstance(value, torch.device)):
        far = device.type == SECOND.type
    if copies:  # else the copy could be the tensor itself
        args = [args[0].clone(), *args[1:]] if func._schema.name != "aten::copy_" else args
    near_args, near_kwargs = tree_map(_near, (tuple(args), kwargs))
    out = func(*near_args, **near_kwargs)
    if func._schema.is_mutable:  # in place
        return args[0]
    return tree_map(lambda value: Far(value) if far and isinstance(value, torch.Tensor) else value, out)


def _near(value: Any) -> Any:
    if isinstance(value, torch.device):
        return torch.device("cpu")
    return value.near if isinstance(value, Far) else value


@contextmanager
def second_device() -> Iterator[torch.device]:
    """Makes tensors on `SECOND` possible."""
    with _Second():
        yield SECOND
