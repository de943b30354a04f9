"""A step over tensors that stay where they are, as one CUDA graph.

A step of a small network is hundreds of kernels of a few microseconds, each of which takes Python and the
driver longer to start than the GPU to compute. A graph is recorded once and then started as a whole. It
computes what it was recorded with: the same tensors at the same addresses, of the same shapes and by the same
Python numbers. So such a step reads all that changes from tensors, and never waits for the device.

It is recorded by hand and not by `torch.compile`: the kernels and their roundings stay those of the step,
which may be compiled itself, and recording takes as long as two steps do.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

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
    current = torch.cuda.current_stream(device)
    graph = torch.cuda.CUDAGraph()
    side = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
    side.wait_stream(current)
    # A place that is written once a step needs no sorting of indices, as places do in deterministic mode.
    deterministic = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(False)
    try:
        # The outer context puts the stream back where the inner one fails, which does not do so itself.
        with torch.cuda.device(device), torch.cuda.stream(side):
            step()  # libraries choose kernels and tensors get their places, which no graph could hold
            # Whoever records graphs of compiled code frees the workspaces of matrix products, and this graph
            # would go on writing to them: those that are made while it is recorded are its own.
            torch._C._cuda_clearCublasWorkspaces()
            # Loaders copy batches to the device in other threads meanwhile.
            with torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"):
                step()
            torch._C._cuda_clearCublasWorkspaces()
    except RuntimeError as error:
        first = next(iter(str(error).strip().splitlines()), type(error).__name__)
        warnings.warn(f"no CUDA graph of a step was made, it goes on without: {first}", stacklevel=2)
        return step
    finally:
        torch.use_deterministic_algorithms(deterministic)
        current.wait_stream(side)
    return graph.replay
