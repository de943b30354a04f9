"""Losses that torch compiles, and that are computed without where it cannot.

Graphs are kept while networks of the same structure are trained, such as the same with another seed; those of
another are dropped, as they may hold as much memory as a step takes. Kernels are kept on disk as well, in
`TORCHINDUCTOR_CACHE_DIR`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

GRAPHS = 64
"""Graphs that one function may have: shapes of batches, training and validation, each kind of stage."""


class Compiled:
    """A function of losses, compiled as one graph when it is called; the network is what it trains."""

    _structure = ""
    """Structure of the network whose graphs are kept."""

    def __init__(
        self, losses: Callable[..., dict[str, Tensor]], net: nn.Module, *, graphs: bool = False
    ) -> None:
        self.losses, self.net, self.graphs = losses, net, graphs
        self.compiled: Callable[..., dict[str, Tensor]] | None = None

    def __call__(self, *arguments: Any) -> dict[str, Tensor]:
        """Return the losses."""
        from torch._dynamo import exc

        if self.compiled is None:
            self.compiled = self._compile()
        failures = RuntimeError if self.graphs else exc.TorchDynamoException  # graphs fail as they run, too
        if self.graphs:
            torch.compiler.cudagraph_mark_step_begin()  # type: ignore[no-untyped-call]
        try:
            return self.compiled(*arguments)
        except (failures, exc.FailOnRecompileLimitHit) as error:
            reason = getattr(error, "inner_exception", error)
            first = next(iter(str(reason).strip().splitlines()), type(reason).__name__)
            warnings.warn(f"torch.compile failed, training goes on without: {first}", stacklevel=2)
            self.compiled = self.losses
            if self.graphs:  # which may have drawn
                torch.manual_seed(torch.initial_seed())
            return self.losses(*arguments)

    def _compile(self) -> Callable[..., dict[str, Tensor]]:
        from torch._dynamo import config
        from torch._functorch import config as functorch

        structure = f"{type(self.losses.__self__)} {self.net}"  # type: ignore[attr-defined]
        if structure != Compiled._structure:
            torch.compiler.reset()
        Compiled._structure = structure
        config.recompile_limit = GRAPHS
        # A failure of the backward pass must be found before the forward pass has taught codebooks.
        functorch.force_non_lazy_backward_lowering = True
        options: dict[str, str | int | bool | Callable[..., Any]] = {
            "triton.cudagraphs": self.graphs,
            "deterministic": torch.are_deterministic_algorithms_enabled(),
        }
        return torch.compile(self.losses, fullgraph=True, options=options)
