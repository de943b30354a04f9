"""Weights in half precision: half the bytes, the nearest 16-bit numbers, a model that generates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.store.weights import halve_weights


def test_what_has_no_room_in_half_precision_stays(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    small = torch.tensor([1.0, 1e-3, -65504.0])
    state = {
        "small": small,
        "large": torch.tensor([1.0, 1e6]),
        "infinite": torch.tensor([1.0, float("inf")]),
        "whole": torch.tensor([70000, 1]),
        "double": torch.tensor([0.1], dtype=torch.float64),
    }
    save_file(state, path)
    halve_weights(path)
    found = load_file(path)
    assert found["small"].dtype == torch.float16 and torch.equal(found["small"], small.half())
    for name in ("large", "infinite", "whole", "double"):
        assert found[name].dtype == state[name].dtype and torch.equal(found[name], state[name])


def test_a_half_export_generates(small_run: Any, call: Any, tmp_path: Path) -> None:
    assert call("export", small_run.folder, "-o", tmp_path / "half", "--half").code == 0
    halves = sorted((tmp_path / "half").glob("*/model.safetensors"))
    wholes = [small_run.folder / "stages" / path.parent.name / path.name for path in halves]
    sizes = [sum(path.stat().st_size for path in paths) for paths in (halves, wholes)]
    assert sizes[0] < 0.6 * sizes[1]
    for path, whole in zip(halves, wholes, strict=True):
        halved = load_file(path)
        for name, value in load_file(whole).items():
            # Half precision rounds to 11 bits, and to steps of 2^-24 below its smallest normal number.
            torch.testing.assert_close(
                halved[name].to(value.dtype), value, rtol=2**-11, atol=2**-25, msg=name
            )
    model = MotionModel.from_pretrained(tmp_path / "half", device="cpu")
    made = model.generate(["a person walks forward"], seconds=1.0)[0]
    assert len(made.joints) == made.layout.fps and np.isfinite(made.joints).all()
