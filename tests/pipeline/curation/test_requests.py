"""What captions ask for, by their words; and whether joints show it."""

from __future__ import annotations

from typing import Any

import pytest

from motionloom.datasets.actions.measure import actions_of, find_mismatch
from motionloom.datasets.actions.requests import CaptionRequest
from motionloom.datasets.synth.generate import Clip, SynthConfig, make_clip
from motionloom.pipeline.curation.requests import parse_actions, parse_requests

CONFIG = SynthConfig(clips=400, seed=3, actions="all")
FPS = CONFIG.motion_layout.fps


def then(*actions: str) -> dict[str, Any]:
    return {"action": "then", "parts": [{"action": action} for action in actions]}


FISTS = {"left_hand": "fist", "right_hand": "fist"}
SLOWLY = {"action": "then", "parts": [{"action": "walk", "speed": "slowly"}, {"action": "wave"}]}


@pytest.mark.parametrize(
    ("caption", "asked"),
    [
        ("a person waves with the left hand", [{"action": "wave", "side": "left"}]),
        ("hands up", [{"action": "raise", "side": "both"}]),
        ("two quick left jabs", [{"action": "punch", "side": "left", "count": 2, "speed": "quickly"}]),
        ("jump jump jump", [{"action": "jump", "count": 3}]),
        ("the boxer kicks one time", [{"action": "kick", "count": 1}]),
        ("he gives it a kick with both hands in fists", [{"action": "kick"} | FISTS]),
        ("squats with clenched fists", [{"action": "squat"} | FISTS]),
        ("claps, left hand open", [{"action": "clap", "left_hand": "spread"}]),
        ("side steps to the left", [{"action": "walk", "direction": "sideways", "side": "left"}]),
        ("a side kick with the left leg", [{"action": "kick", "side": "left", "direction": "sideways"}]),
        ("walks for ten seconds", [{"action": "walk", "seconds": 10}]),
        ("walks slowly, then waves twice", [SLOWLY]),
        ("walk and turn right", [{"action": "turn", "direction": "right"}]),
        ("she steps back, taking three steps", [{"action": "walk", "direction": "backward", "count": 3}]),
        ("strolls anti-clockwise", [{"action": "walk", "direction": "counterclockwise"}]),
        ("he runs in a circle", [{"action": "run", "path": "a circle"}]),
        ("she walks slowly", [{"action": "walk", "speed": "slowly"}]),
        ("point to the left with the right hand", [{"action": "point", "side": "right"}]),
        ("reach up high", [{"action": "reach", "direction": "up"}, {"action": "raise"}]),
        ("wave and then kick", [then("wave", "kick")]),
        ("he claps after he bows", [then("bow", "clap")]),
        ("a person plays the violin", []),
        ("", []),
    ],
)
def test_what_a_caption_asks_for(caption: str, asked: list[dict[str, Any]]) -> None:
    assert parse_requests(caption) == CaptionRequest(tuple(asked))


@pytest.mark.parametrize(
    ("caption", "without"),
    [
        ("nobody kicks", "kick"),
        ("he doesn't wave", "wave"),
        ("stop walking", "walk"),
        ("kick, hop, wave", ""),
        ("a dog runs across the garden", ""),
    ],
)
def test_what_is_taken_back_or_too_much_is_refused(caption: str, without: str) -> None:
    assert parse_requests(caption) == CaptionRequest(refused=True, without=tuple(without.split()))


def test_a_long_caption_takes_no_time() -> None:
    assert parse_actions("takes " + "very " * 20_000 + "swung " * 2_000) == ()


def clip(action: str, **wanted: object) -> Clip:
    made = (make_clip(k, CONFIG) for k in range(CONFIG.clips))
    return next(one for one in made if {"action": action, **wanted}.items() <= one.truth.items())


def test_true_requests_are_shown_and_others_are_not() -> None:
    wave = clip("wave").joints
    for action in ("walk", "turn", "run", "jump", "squat", "kick", "clap", "hop", "punch", "bow", "crawl"):
        assert find_mismatch([{"action": action}], clip(action).joints, FPS) is None
        assert action in (find_mismatch([{"action": action}], wave, FPS) or "")
    assert find_mismatch([{"action": "sit"}, {"action": "wave"}], wave, FPS) is None


@pytest.mark.parametrize(
    ("action", "asked", "seen"),
    [
        ("walk", {"speed": "quickly"}, ["speed", "quickly"]),
        ("run", {"path": "a circle"}, ["path", "circle"]),
        ("raise", {"side": "both"}, ["side", "left", "both"]),
        ("raise", {"side": "left"}, []),
    ],
)
def test_attributes_are_compared(action: str, asked: dict[str, str], seen: list[str]) -> None:
    truth: dict[str, object] = {"side": "left"} if action == "raise" else {"speed": None}
    joints = clip(action, **truth).joints
    found = find_mismatch([{"action": action, **asked}], joints, FPS)
    assert (found is not None) == bool(seen) and all(word in (found or "") for word in seen)


def test_actions_of_a_truth() -> None:
    chained = clip("then").truth
    assert actions_of(chained) == tuple(part["action"] for part in chained["parts"])
    assert find_mismatch([chained], clip("then").joints, FPS) is None
    assert actions_of({"action": "wave", "side": "left"}) == ("wave",)
    assert actions_of(None) == actions_of({"song": 3}) == ()
