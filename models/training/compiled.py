"""Losses compiled with torch.compile, with a fall-back to eager mode where that fails.

Graphs are kept while networks of one structure are trained, such as one network with several seeds. A network
of another structure drops them, as they may hold as much memory as a step takes. Kernels are also kept on
disk, in `TORCHINDUCTOR_CACHE_DIR`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from motionloom.datasets.conditions import Condition

GRAPHS = 64
"""Graphs that one function may have: shapes of batches, training and validation, each kind of stage."""

WORD_MULTIPLE = 16
"""Captions of a batch are padded to a multiple of so many words, and sequences to one of so many tokens: a
CUDA graph has one shape, and each length would need its own."""


class Compiled:
    """A loss function compiled as one graph at its first call; `net` is the network it trains."""

    _structure = ""
    """Structure of the network whose graphs are kept."""

    def __init__(
        self, losses: Callable[..., dict[str, Tensor]], net: nn.Module, *, graphs: bool = False
    ) -> None:
        self.losses = losses
        self.net = net
        self.graphs = graphs
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
            if self.graphs:
                return self.compiled(*(_pad_tokens(_pad_conditions(one), self.net) for one in arguments))
            return self.compiled(*arguments)
        except (failures, exc.FailOnRecompileLimitHit) as error:
            if self.graphs:  # which may have drawn
                torch.manual_seed(torch.initial_seed())
            self.leave(error)
            return self.losses(*arguments)

    def leave(self, error: Exception) -> None:
        """Compute in eager mode from here on, after one warning that says why."""
        reason = getattr(error, "inner_exception", error)
        first = next(iter(str(reason).strip().splitlines()), type(reason).__name__)
        warnings.warn(f"torch.compile failed, training goes on without: {first}", stacklevel=3)
        self.compiled = self.losses
        self.graphs = False

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


def _pad_conditions(argument: object) -> object:
    """Return a batch with captions padded to a multiple of `WORD_MULTIPLE` words; others unchanged."""
    if not isinstance(argument, dict) or not isinstance(argument.get("conditions"), dict):
        return argument
    filled = {name: _pad_words(condition) for name, condition in argument["conditions"].items()}
    return {**argument, "conditions": filled}


def _pad_tokens(argument: object, net: nn.Module) -> object:
    """Return a batch with sequences padded to a multiple of `WORD_MULTIPLE` tokens, or as many as the network
    takes: a GPT of 150 has ten lengths.
    """
    most = getattr(getattr(net, "config", None), "block_size", 0)
    if not most or not isinstance(argument, dict) or "tokens" not in argument:
        return argument
    size = argument["tokens"].shape[1]
    more = max(0, min(size + -size % WORD_MULTIPLE, most) - size)
    behind = {"tokens": -1, "kinds": 0, "known": True}
    return {
        name: pad(value, (0, more), value=behind[name]) if name in behind else value
        for name, value in argument.items()
    }


def _pad_words(condition: Condition) -> Condition:
    """Return a text condition padded with masked words; conditions timed by frames are returned unchanged."""
    more = -condition.mask.shape[1] % WORD_MULTIPLE
    if condition.pooled is None or not more:
        return condition
    return condition._replace(
        features=pad(condition.features, (0, 0, 0, more)), mask=pad(condition.mask, (0, more))
    )
