"""A trained model behind the server: many at once, beside the model itself."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from motionloom.pipeline.inference.model import MotionModel

pytestmark = pytest.mark.slow


def test_each_gets_the_motion_of_its_own_seed(small_run: Any, run_server: Callable[..., Any]) -> None:
    model = MotionModel.from_pretrained(small_run.folder, device="cpu")
    captions = [f"a person {word}" for word in ("waves", "walks", "bows")]
    wanted = {
        number: model.generate([captions[number % 3]], seconds=0.6, seed=number)[0].joints
        for number in range(12)
    }

    def ask(number: int) -> None:
        asked = {"caption": captions[number % 3], "seconds": 0.6, "seed": number}
        said = served.post("/api/generate", asked).json
        np.testing.assert_allclose(said["joints"], wanted[number], atol=1e-5)

    assert len(model.examples()) == 6, "what the page offers before anything is asked"
    with run_server(model, waiting=12) as served, ThreadPoolExecutor(12) as clients:
        list(clients.map(ask, range(12)))
        strange = served.post("/api/generate", {"caption": "a person plays the violin", "seconds": 0.6})
        assert "unlike all captions" in strange.json["notes"][0]
        bad = served.post("/api/generate", {"caption": "a", "seconds": 29.0})
        assert bad.status == 400 and "out of reach" in bad.json["error"]
