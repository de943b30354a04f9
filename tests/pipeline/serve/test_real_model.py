"""A trained model behind the server: many at once, and a stream, beside the model itself."""

from __future__ import annotations

import json
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
        got = served.post("/api/stream", {"caption": captions[0], "seconds": 0.6})
        head, *frames = [json.loads(line) for line in got.body.splitlines()]
        assert head["notes"] == []
        strange = {"caption": "a person plays the violin", "seconds": 0.6}
        first = served.post("/api/stream", strange).body.splitlines()[0]
        (note,) = json.loads(first)["notes"]
        assert (
            note == served.post("/api/generate", strange).json["notes"][0] and "unlike all captions" in note
        )
        assert got.headers["content-type"] == "application/x-ndjson"
        np.testing.assert_allclose([frame["joints"] for frame in frames], wanted[0], atol=2e-5)
        bad = served.post("/api/generate", {"caption": "a", "seconds": 29.0})
        assert bad.status == 400 and "out of reach" in bad.json["error"]
