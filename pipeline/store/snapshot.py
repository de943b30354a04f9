"""A training's state as it is now, copied so that it may be written while training goes on."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, UntypedStorage

_UNCHANGING = frozenset({bool, int, float, str, bytes})


class Snapshot:
    """Plain containers and tensors, copied to the memory of the host.

    Tensors that share memory share it in the copy too, so that a file written from it has the bytes of one
    written from the state itself. Copies from a GPU run in the order of its other work, so what is trained
    next does not change them, and this process need not wait for them: whoever reads `content` does.
    """

    def __init__(self, state: dict[str, Any]) -> None:
        self._storages: dict[int, UntypedStorage] = {}
        self._copied: list[Callable[[], None]] = []
        self._devices: set[torch.device] = set()
        self._content: dict[str, Any] = self._copy(state)
        for device in self._devices:
            event = torch.cuda.Event()  # type: ignore[no-untyped-call]
            event.record(torch.cuda.current_stream(device))
            self._copied.append(event.synchronize)
        self._storages = {}

    @property
    def content(self) -> dict[str, Any]:
        """The copy; waits until all of it is here."""
        for wait in self._copied:
            wait()
        return self._content

    def _copy(self, value: Any) -> Any:
        if value is None or type(value) in _UNCHANGING:
            return value
        if isinstance(value, Tensor):
            return self._tensor(value.detach())
        if isinstance(value, dict):
            out = copy.copy(value)  # an OrderedDict stays one, and keeps what torch notes on it
            for key, inner in value.items():
                out[key] = self._copy(inner)
            return out
        if isinstance(value, list):
            return [self._copy(inner) for inner in value]
        if type(value) is tuple:
            return tuple(self._copy(inner) for inner in value)
        return copy.deepcopy(value)

    def _tensor(self, value: Tensor) -> Tensor:
        storage = value.untyped_storage()
        there = storage._cdata
        if there not in self._storages:
            self._storages[there] = self._storage(storage)
        out = torch.empty(0, dtype=value.dtype)
        out.set_(self._storages[there], value.storage_offset(), value.size(), value.stride())
        return out

    def _storage(self, storage: UntypedStorage) -> UntypedStorage:
        gpu = storage.device.type == "cuda"
        if gpu:
            self._devices.add(storage.device)
        out = torch.empty(storage.nbytes(), dtype=torch.uint8, pin_memory=gpu).untyped_storage()
        out.copy_(storage, non_blocking=gpu)
        return out
