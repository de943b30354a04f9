"""Changing clips over HTTP: what is made, what is kept for later, and what is refused."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from motionloom.pipeline.contract.generation import Capabilities

WALK = {"caption": "a person walks", "seconds": 2.0, "seed": 4}
ARM = {
    "keep": [{"parts": ["all"], "but": ["left_arm", "left_hand"]}],
    "pins": [{"at": 1.0, "joint": "left_wrist", "position": [0.75, 1.2, 1.1]}],
}


@pytest.fixture
def served(run_server: Callable[..., Any], quick: Any) -> Iterator[Any]:
    with run_server(quick, max_seconds=5.0, max_clip_mb=0.5, max_caption=40, clips=3) as made:
        yield made


def npz(joints: Any, fps: float = 20.0) -> bytes:
    out = io.BytesIO()
    np.savez(out, joints=joints, metadata=np.array(json.dumps({"fps": fps, "caption": "a walk"})))
    return out.getvalue()


def test_a_motion_that_was_generated_is_changed(served: Any, quick: Any) -> None:
    clip = served.post("/api/generate", WALK).json["clip"]
    said = served.post("/api/edit", {"clip": clip, "task": ARM}).json
    joints, wrist = np.array(said["joints"]), said["joint_names"].index("left_wrist")
    assert said["frames"] == len(joints) == 40
    assert np.linalg.norm(joints[20, wrist] - [0.75, 1.2, 1.1]) < 0.001
    assert "pin left_wrist at 1.00 s: 0.0 cm off" in said["lines"]
    assert said["report"]["pins_cm"] == {"left_wrist at 1.00 s": pytest.approx(0.0, abs=0.01)}
    assert said["report"]["path_cm"] is None, "nothing was asked of it"
    cells = served.post("/api/edit", {"clip": clip, "task": ARM, "format": "viewer"}).json["viewer"][
        "motions"
    ]
    assert [cell["label"] for cell in cells] == ["before", "after"]
    bvh = served.post("/api/edit", {"clip": clip, "task": ARM, "format": "bvh"})
    assert bvh.body.startswith(b"HIERARCHY") and ".bvh" in bvh.headers["content-disposition"]
    assert len(quick.edited) == 1 and quick.asked == ["a person walks"], "made once, and answered three times"
    on = served.post("/api/edit", {"clip": said["clip"], "task": {"seconds": 3.0}}).json
    assert on["frames"] == 60, "a result is a clip of its own"


def test_a_file_is_read_and_changed(served: Any, walk: Callable[..., Any]) -> None:
    said = served.ask("POST", "/api/clips", npz(walk(61, 30.0)[:, :22], 30.0)).json
    assert said["frames"] == pytest.approx(40, abs=1) and said["viewer"]["motions"][0]["joints"] == 52
    assert said["caption"] == "a walk" and "30 frames/s" in said["notes"][0]
    long = served.ask("POST", "/api/clips", npz(walk(110)[:, :22]))
    assert long.status == 400 and "lasts 6 s" in long.json["error"]
    wave = served.post("/api/edit", {"clip": said["clip"], "task": ARM, "format": "bvh"}).body
    read = served.ask("POST", "/api/clips", wave).json
    assert read["frames"] == pytest.approx(said["frames"], abs=1) and read["clip"] != said["clip"]


@pytest.mark.parametrize(
    ("clip", "task", "words"),
    [
        ("gone", ARM, "the clip is not here any more; send it again"),
        (WALK, {"kept": []}, "unknown key 'task.kept'; did you mean 'keep'?"),
        (WALK, {"seconds": 5.5}, "5.5 s were asked for; this server makes at most 5 s"),
        (WALK, {"repeat": 3}, "6 s were asked for"),
        (WALK, {"caption": "w" * 41}, "a caption has 41 letters"),
        (WALK, {"pins": [{"at": 1, "joint": "head", "position": [0, 9, 0]}]}, "out of reach"),
        (3, ARM, "clip"),
    ],
)
def test_what_cannot_be_done_is_one_sentence(served: Any, clip: Any, task: Any, words: str) -> None:
    if clip == WALK:
        clip = served.post("/api/generate", WALK).json["clip"]
    got = served.post("/api/edit", {"clip": clip, "task": task})
    assert got.status == 400 and words in got.json["error"]


@pytest.mark.parametrize(
    ("data", "status", "words"),
    [
        (b"", 400, "the clip: empty (0 bytes)"),
        (b"PK\x03\x04 no archive", 400, "the clip: "),
        (b"glTF\x02\x00\x00\x00", 400, "the clip: "),
        (b"HIERARCHY\nROOT hips {", 400, "the clip: "),
        (b"OggS a song", 400, "the clip: no motion"),
        (npz(np.zeros((3, 22, 3))), 400, "3 frames are no motion"),
        (npz(np.zeros((40, 7, 3))), 400, "[40, 7, 3], wanted [T, 22 or 52, 3]"),
        (npz(np.full((40, 22, 3), np.nan)), 400, "the clip: "),
        (bytes(600_000), 413, "the clip is larger than this server takes: at most 524288 bytes"),
    ],
)
def test_what_is_no_clip(served: Any, data: bytes, status: int, words: str) -> None:
    got = served.ask("POST", "/api/clips", data)
    assert got.status == status and words in got.json["error"] and "/tmp" not in got.json["error"]


def test_a_model_that_makes_whole_motions_says_so(run_server: Callable[..., Any], quick: Any) -> None:
    quick.bundle.generator = SimpleNamespace(
        modalities=quick.modalities, settings=frozenset(), capabilities=Capabilities(), method="gpt"
    )
    with run_server(quick) as served:
        edit = served.ask("GET", "/api/info").json["edit"]
        assert edit["possible"] is False and "edits none" in edit["why"]
        for got in (
            served.post("/api/edit", {"clip": "any", "task": ARM}),
            served.ask("POST", "/api/clips", b"HIERARCHY"),
        ):
            assert got.status == 400 and got.json["error"] == edit["why"]
