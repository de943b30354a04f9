"""Changes of conditions that the diffusion decoder bridges: what it is not shown, and who can do so."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from motionloom.pipeline.inference.generators.ude import bridged
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.script import Script, ScriptSegment


def shown(hidden: torch.Tensor) -> list[str]:
    return ["".join("x" if here else "." for here in row) for row in hidden.tolist()]


def test_half_before_and_half_behind_each_border() -> None:
    groups = torch.tensor([[6, 8], [8, 6], [6, 5]])
    assert shown(bridged(groups, 4)) == ["....xxxx....xxxx....", "......xxxx..xxxx...."]
    assert shown(bridged(groups, 3)) == [".....xxx.....xxx....", ".......xxx...xxx...."]
    assert not bridged(groups[:1], 4).any()


def test_short_stretches_keep_half_of_their_tokens() -> None:
    assert shown(bridged(torch.tensor([[2], [3], [8]]), 6)) == [".xx.xxxx....."]
    assert shown(bridged(torch.tensor([[1], [1], [1]]), 6)) == ["..."]


@pytest.mark.slow
def test_a_script_is_the_same_away_from_its_borders(ude_run: Any) -> None:
    """A bridge changes what is around its border, and no token."""
    words = Script(
        segments=[ScriptSegment(text=f"a person {what}", seconds=12) for what in ("squats", "walks forward")]
    )
    motions = []
    for frames in (0, 16):
        model = MotionModel.from_pretrained(ude_run.folder, device="cpu")
        generator: Any = model.bundle.generator
        config = generator.config.model_copy(update={"bridge_frames": frames})
        object.__setattr__(generator, "config", config)
        motions.append(model.perform(words, seed=3)[0].features)
    plain, bridge = motions
    assert plain.shape == bridge.shape
    apart = np.abs(plain - bridge).max(1)
    assert apart[232:248].min() > 1e-4
    # Overlapping windows of 64 frames carry a difference 32 frames further with each of the four steps.
    assert apart[:64].max() < 1e-4 * np.abs(plain).max()


@pytest.mark.slow
def test_a_decoder_that_never_filled_in_is_refused(
    ude_run: Any, call: Callable[..., Any], tmp_path: Path
) -> None:
    done = call("run", ude_run.recipe, "-o", tmp_path / "run", "--set", "dmd.net.hide=0", "--dry-run")
    assert done.code == 2
    assert "bridge_frames 16 " in done.err
    assert "hide: 0.5" in done.err
