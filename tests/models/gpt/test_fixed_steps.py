"""Steps of fixed shapes, which a GPU records as one graph, against attention over the positions so far."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from second_device import SECOND, WAITS, Far, second_device
from toy_gpt import row_of, toy_gpt

from motionloom.models.gpt import decoding, sampling
from motionloom.models.gpt.rows import Drawing
from motionloom.models.gpt.sampling import generate

VIEWS = "alias chunk detach expand permute select slice split t transpose view unsqueeze _unsafe_view"
"""Operations that launch no kernel."""


def test_drawn_as_with_a_growing_cache_and_never_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calls of two networks in turn, whose weights move; on a device that is waited for."""
    inside, made, launched, steps = [False], [], list[str](), [0]

    def recorded(step: Callable[[], None], device: torch.device) -> Callable[[], None]:
        def again() -> None:
            inside[0] = True
            steps[0] += 1
            step()
            inside[0] = False

        made.append(device)
        step()  # as for a graph: what is drawn here must leave nothing
        return again

    def watch(name: str, args: Sequence[Any], out: Any) -> None:
        short = name.removeprefix("aten::")
        copied = "copy" in short and not all(isinstance(one, Far) for one in (args[0], out))
        assert not inside[0] or not (short in WAITS or copied), name
        launched.extend([short] if inside[0] and short not in VIEWS.split() else [])

    monkeypatch.setattr(decoding, "recorded", recorded)
    monkeypatch.setattr(sampling, "_FIXED", {SECOND.type})
    nets = [(toy_gpt(std=std).double(), toy_gpt(std=std).double()) for std in (0.2, 0.5)]
    hows, draws = (Drawing(), Drawing(0), Drawing(1.3, 3, 0.8), Drawing(0.7, None, 0.9)), torch.Generator()
    with second_device(watch):
        for seed in range(12):  # three calls in a row of one shape and network
            (near, far), half = nets[seed % 2], seed // 6
            draws.manual_seed(seed)
            for weight in near.parameters():
                weight.data += 0.1 * torch.randn(weight.shape, generator=draws, dtype=weight.dtype)
            far.to(SECOND).load_state_dict(near.state_dict())
            groups = torch.randint(1, 10, (1,), generator=draws) if half else None
            text = torch.randn(2 - half, 6, generator=draws, dtype=torch.float64)
            how: dict[str, Any] = {"how": hows[half * 2 + seed % 2], "cfg_scale": (1.0, 2.5)[half]}
            want = generate(near, text, groups=groups, seed=seed, **how)
            with torch.inference_mode(seed % 6 < 2):
                found = generate(far, text.to(SECOND), groups=groups, seed=seed, **how)
            for index in range(2 - half):
                assert row_of(found, index) == row_of(want, index), seed
    assert len(made) == 5 and all(far in decoding._KEPT for _, far in nets)
    # Launches are what a token of one motion takes a GPU: 11 of a layer, and what is drawn by.
    assert len(launched) <= steps[0] * (11 * 2 + 45), {name: launched.count(name) for name in set(launched)}
