"""Steps of fixed shapes, which a GPU records as one graph, against attention over the positions so far."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from second_device import SECOND, second_device
from toy_gpt import toy_gpt

from motionloom.models.gpt import sampling
from motionloom.models.gpt.sampling import Drawing, generate

WAITS = ("_local_scalar_dense", "item", "nonzero", "masked_select", "_unique2")
"""Operations that read from the device."""


def test_drawn_as_with_a_growing_cache_and_never_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calls of two networks in turn, whose weights move; on a device that is waited for."""
    watched, made = [False], [0]

    def recorded(step: Callable[[], None], device: torch.device) -> Callable[[], None]:
        def again() -> None:
            watched[0] = True
            step()
            watched[0] = False

        assert device == SECOND
        made[0] += 1
        step()  # as for a graph: what is drawn here must leave nothing
        return again

    def watch(name: str, args: Sequence[Any], out: Any) -> None:
        short = name.removeprefix("aten::")
        copied = short in ("_to_copy", "copy_") and any(
            isinstance(one, torch.Tensor) and one.device != SECOND for one in (*args[:2], out)
        )
        assert not (watched[0] and (short in WAITS or copied)), name

    monkeypatch.setattr(sampling, "recorded", recorded)
    monkeypatch.setattr(sampling, "_FIXED", {SECOND.type})
    nets = [(toy_gpt(std=std).double(), toy_gpt(std=std).double()) for std in (0.2, 0.5)]
    hows, draws = (Drawing(), Drawing(0), Drawing(1.3, 3, 0.8), Drawing(0.7, None, 0.9)), torch.Generator()
    with second_device(watch):
        for seed in range(12):
            draws.manual_seed(seed)
            # Three calls in a row of one shape and network, by other weights.
            (near, far), half = nets[seed % 2], seed // 6
            for weight in near.parameters():
                weight.data += 0.1 * torch.randn(weight.shape, generator=draws, dtype=weight.dtype)
            far.to(SECOND).load_state_dict(near.state_dict())
            batch, groups = 1 + half, None
            if half == 0:
                groups = torch.randint(1, 10, (batch,), generator=draws)
            given: dict[str, Any] = {"how": hows[half * 2 + seed % 2], "cfg_scale": (1.0, 2.5)[half]}
            text = torch.randn(batch, 6, generator=draws, dtype=torch.float64)
            want = generate(near, text, groups=groups, seed=seed, **given)
            with torch.inference_mode(seed % 6 < 2):
                found = generate(far, text.to(SECOND), groups=groups, seed=seed, **given)
            assert found.groups.tolist() == want.groups.tolist(), seed
            for name, codes in want.codes.items():
                assert found.codes[name].tolist() == codes.tolist(), (seed, name)
    assert made[0] == 4
    assert all(far in sampling._KEPT and near not in sampling._KEPT for near, far in nets)
