"""The published evaluator of Guo et al. in plain tensor operations, one sample and one step at a time.

`weights` are tensors by their published names, in the published shapes (`SHAPES`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

UNITS, FRAMES = 4, 196


def _gru(name: str, hidden: int) -> dict[str, tuple[int, ...]]:
    out: dict[str, tuple[int, ...]] = {}
    for end in ("", "_reverse"):
        for kind in ("ih", "hh"):
            out[f"{name}.gru.weight_{kind}_l0{end}"] = (3 * hidden, hidden)
            out[f"{name}.gru.bias_{kind}_l0{end}"] = (3 * hidden,)
    return out


def _linear(name: str, inputs: int, outputs: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


SHAPES: dict[str, tuple[int, ...]] = {
    "movement_encoder.main.0.weight": (512, 259, 4),
    "movement_encoder.main.0.bias": (512,),
    "movement_encoder.main.3.weight": (512, 512, 4),
    "movement_encoder.main.3.bias": (512,),
    **_linear("movement_encoder.out_net", 512, 512),
    "motion_encoder.hidden": (2, 1, 1024),
    **_linear("motion_encoder.input_emb", 512, 1024),
    **_gru("motion_encoder", 1024),
    **_linear("motion_encoder.output_net.0", 2048, 1024),
    "motion_encoder.output_net.1.weight": (1024,),
    "motion_encoder.output_net.1.bias": (1024,),
    **_linear("motion_encoder.output_net.3", 1024, 512),
    "text_encoder.hidden": (2, 1, 512),
    **_linear("text_encoder.pos_emb", 15, 300),
    **_linear("text_encoder.input_emb", 300, 512),
    **_gru("text_encoder", 512),
    **_linear("text_encoder.output_net.0", 1024, 512),
    "text_encoder.output_net.1.weight": (512,),
    "text_encoder.output_net.1.bias": (512,),
    **_linear("text_encoder.output_net.3", 512, 512),
}


def slow_motion(weights: Mapping[str, Tensor], motion: Tensor) -> Tensor:
    """Latent [512] of normalised features [T, 263]."""
    units = len(motion) // UNITS
    x = torch.zeros(FRAMES, 259, dtype=motion.dtype)
    x[: units * UNITS] = motion[: units * UNITS, :-4]
    for layer in ("main.0", "main.3"):
        weight, bias = (weights[f"movement_encoder.{layer}.{kind}"] for kind in ("weight", "bias"))
        edge = torch.zeros(1, x.shape[1], dtype=x.dtype)
        padded = torch.cat([edge, x, edge])
        rows = []
        for first in range(0, len(padded) - 3, 2):
            taps = [weight[:, :, tap] @ padded[first + tap] for tap in range(4)]
            rows.append(_leaky(sum(taps, bias)))
        x = torch.stack(rows)
    x = torch.stack([_apply(weights, "movement_encoder.out_net", row) for row in x])
    return _read(weights, "motion_encoder", x[:units])


def slow_text(weights: Mapping[str, Tensor], words: Sequence[tuple[Tensor, int]]) -> Tensor:
    """Latent [512] of words: each a vector [300] and the number of its class."""
    classes = torch.eye(15, dtype=weights["text_encoder.hidden"].dtype)
    rows = [vector + _apply(weights, "text_encoder.pos_emb", classes[kind]) for vector, kind in words]
    return _read(weights, "text_encoder", torch.stack(rows))


def _read(weights: Mapping[str, Tensor], name: str, x: Tensor) -> Tensor:
    x = torch.stack([_apply(weights, f"{name}.input_emb", row) for row in x])
    ends = []
    for direction, (end, rows) in enumerate((("", x), ("_reverse", x.flip(0)))):
        state = weights[f"{name}.hidden"][direction, 0]
        parts = [f"{name}.gru.{kind}_l0{end}" for kind in ("weight_ih", "bias_ih", "weight_hh", "bias_hh")]
        w, b, u, c = (weights[part] for part in parts)
        for row in rows:
            given, before = (w @ row + b).chunk(3), (u @ state + c).chunk(3)
            reset, update = (1 / (1 + torch.exp(-given[k] - before[k])) for k in (0, 1))
            new = torch.tanh(given[2] + reset * before[2])
            state = (1 - update) * new + update * state
        ends.append(state)
    h = _apply(weights, f"{name}.output_net.0", torch.cat(ends))
    h = (h - h.mean()) / (h.var(unbiased=False) + 1e-5).sqrt()
    h = h * weights[f"{name}.output_net.1.weight"] + weights[f"{name}.output_net.1.bias"]
    return _apply(weights, f"{name}.output_net.3", _leaky(h))


def _apply(weights: Mapping[str, Tensor], name: str, x: Tensor) -> Tensor:
    return weights[f"{name}.weight"] @ x + weights[f"{name}.bias"]


def _leaky(x: Tensor) -> Tensor:
    return torch.where(x > 0, x, 0.2 * x)
