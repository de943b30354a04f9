"""A step over tensors that stay where they are, as one CUDA graph.

A step of a small network is hundreds of kernels of a few microseconds, each of which takes Python and the
driver longer to start than the GPU to compute. A graph is recorded once and then started as a whole. It
computes what it was recorded with: the same tensors at the same addresses, of the same shapes and by the same
Python numbers. So such a step reads all that changes from tensors, and never waits for the device.

It is recorded by hand and not by `torch.compile`: the kernels and their roundings stay those of the step, and
recording takes as long as two steps do.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch


def recorded(step: Callable[[], None], device: torch.device) -> Callable[[], None]:
    """Return what does `step` over and over: a CUDA graph of it; on other devices and, with a warning, where
    none can be made, the step itself.

    The step is taken once for this, under the autocast of the caller, so its tensors hold something else
    afterwards.
    """
    if device.type != "cuda":
        step()
        return step
    current, graph = torch.cuda.current_stream(device), torch.cuda.CUDAGraph()
    side = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
    side.wait_stream(current)
    try:
        # The outer context puts the stream back where the inner one fails, which does not do so itself.
        with torch.cuda.device(device), torch.cuda.stream(side), _unrestrained():
            step()  # libraries choose kernels and tensors get their places, which no graph could hold
            # Loaders copy batches to the device in other threads meanwhile.
            record = torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local")
            with _own_workspaces(), record:
                step()
    except RuntimeError as error:
        first = next(iter(str(error).strip().splitlines()), type(error).__name__)
        warnings.warn(f"no CUDA graph of a step was made, it goes on without: {first}", stacklevel=2)
        return step
    finally:
        current.wait_stream(side)
    return graph.replay


@contextmanager
def _unrestrained() -> Iterator[None]:
    """Inside, no operation is replaced by one that is deterministic for any input: a place that is written
    once a step needs no sorting of indices, which takes several kernels in every layer.
    """
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(False)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before)


@contextmanager
def _own_workspaces() -> Iterator[None]:
    """Inside, matrix products allocate workspaces anew, which are then the graph's memory: those outside are
    freed by whoever records graphs of compiled code, and a graph would go on writing to them.
    """
    torch._C._cuda_clearCublasWorkspaces()
    try:
        yield
    finally:
        torch._C._cuda_clearCublasWorkspaces()
