"""A second device for machines without one: it computes on the CPU and refuses tensors of another device.

Within `second_device()`, whatever is put on `SECOND` is a `Far` tensor. As with a GPU, an operation on far
and near tensors together is an error (numbers, tensors of no dimension, and copies aside), and numpy takes
near tensors only. It shows that every tensor a network is given lies where the network lies, in training
too. It does not show what a GPU's own kernels do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode


class _Backend(backend_registration._DummyBackendModule):
    """What torch asks of the module of a device that is not its own."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        """There is no autocast there; only turning it off is asked for."""
        return [torch.bfloat16]


# The place that torch keeps for devices of others, without kernels: autograd has to know a device.
backend_registration._setup_privateuseone_for_python_backend("second_device", _Backend())
SECOND = torch.device("second_device", 0)

Watch = Callable[[str, Sequence[Any], Any], None]
"""Gets every operation's name, such as "aten::add", its arguments and its result."""

WAITS = {"_local_scalar_dense", "item", "nonzero", "masked_select", "is_nonzero", "_unique2"}
"""Operations that read from the device."""

_COPIES = {"aten::copy_", "aten::_to_copy", "aten::to"}
_INDEXED = {"aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_"}
"""As with a GPU, their indices may lie anywhere."""


class Far(torch.Tensor):
    """A tensor that says it is on `SECOND`; `near` holds its values."""

    near: torch.Tensor

    @staticmethod
    def __new__(cls, near: torch.Tensor) -> Far:
        with torch.inference_mode(False):  # a view of a tensor made before inference could not be one of it
            made: Far = torch.Tensor._make_wrapper_subclass(
                cls, near.shape, strides=near.stride(), dtype=near.dtype, device=SECOND
            )
        made.near = near
        return made

    def tolist(self) -> Any:
        return self.near.tolist()

    @classmethod
    def __torch_dispatch__(
        cls, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        return _run(func, args, dict(kwargs or {}))


class _Second(TorchDispatchMode):
    def __init__(self, watch: Watch | None) -> None:
        super().__init__()
        self.watch = watch

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        kwargs = dict(kwargs or {})
        if Far not in types and not any(isinstance(x, torch.device) for x in (*args, *kwargs.values())):
            return func(*args, **kwargs)  # the CPU's own affair
        out = _run(func, args, kwargs)
        if self.watch is not None:
            self.watch(func._schema.name, args, out)
        return out


def _run(func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    values: list[Any] = []
    near_args, near_kwargs = _near(args, values), _near(kwargs, values)
    far = any(type(value) is Far for value in values)
    copies = func._schema.name in _COPIES
    if func._schema.name in _INDEXED:
        values = [args[0], *args[2:3]]
    strange = [v for v in values if isinstance(v, torch.Tensor) and type(v) is not Far and v.dim()]
    if far and strange and not copies:
        raise RuntimeError(f"{func}: expected all tensors on {SECOND}, found {strange[0].shape} on the CPU")
    for device in (value for value in values if isinstance(value, torch.device)):
        far = device.type == SECOND.type
    if copies and func._schema.name != "aten::copy_":  # else the copy could be the tensor itself
        near_args[0] = near_args[0].clone()
    out = _ELSEWHERE.get(func._schema.name, func)(*near_args, **near_kwargs)
    if func._schema.is_mutable:  # in place
        if func._schema.name == "aten::transpose_":  # as a GRU does
            with torch._C._DisableTorchDispatch():
                func(*args, **kwargs)
        return args[0] if func._schema.returns else None
    return _far(out) if far else out


def _near(value: Any, met: list[Any]) -> Any:
    """A value with near tensors only; `met` gets its tensors and devices. Torch's own way is far slower."""
    if isinstance(value, (torch.Tensor, torch.device)):
        met.append(value)
        return torch.device("cpu") if isinstance(value, torch.device) else getattr(value, "near", value)
    if isinstance(value, (list, tuple)):
        return [_near(one, met) for one in value]
    if isinstance(value, dict):
        return {name: _near(one, met) for name, one in value.items()}
    return value


def _far(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return Far(value)
    return type(value)([_far(one) for one in value]) if isinstance(value, (list, tuple)) else value


def _gru_cell(into: Any, of: Any, state: Any, into_bias: Any = None, of_bias: Any = None) -> Any:
    (r, z, new), (r_of, z_of, new_of) = (into + into_bias).chunk(3, 1), (of + of_bias).chunk(3, 1)
    r, z = (r + r_of).sigmoid(), (z + z_of).sigmoid()
    new = (new + r * new_of).tanh()
    return new + z * (state - new), torch.cat([r, z, new, state, new_of], 1)


def _gru_cell_backward(grad: Any, kept: Any, has_bias: bool) -> Any:
    r, z, new, state, new_of = kept.chunk(5, 1)
    to_z, to_new = grad * (state - new) * z * (1 - z), grad * (1 - z) * (1 - new.square())
    to_r = to_new * new_of * r * (1 - r)
    into, of = torch.cat([to_r, to_z, to_new], 1), torch.cat([to_r, to_z, to_new * r], 1)
    return into, of, grad * z, into.sum(0), of.sum(0)


_ELSEWHERE = {
    "aten::_thnn_fused_gru_cell": _gru_cell,
    "aten::_thnn_fused_gru_cell_backward": _gru_cell_backward,
}
"""Operations that only other devices have."""


@contextmanager
def second_device(watch: Watch | None = None) -> Iterator[torch.device]:
    """Makes tensors on `SECOND` possible."""
    # `torch.tensor(..., device=SECOND)` makes its tensor on the CPU and then copies it, which the mode sees.
    torch._C._set_only_lift_cpu_tensors(True)
    try:
        with _Second(watch), torch.autograd.set_multithreading_enabled(False):
            yield SECOND
    finally:
        torch._C._set_only_lift_cpu_tensors(False)
