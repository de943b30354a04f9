"""What captions say by their words."""

from __future__ import annotations

import pytest

from motionloom.datasets.synth.actions.truth import ACTIONS, Record
from motionloom.datasets.text import said
from motionloom.datasets.text.other_actions import OTHER_ACTIONS
from motionloom.datasets.text.said import acts_said, asked_of, meant_by
from motionloom.datasets.text.words import taken_back


def test_every_action_of_the_synthetic_clips_has_words() -> None:
    assert set(said._MORE) == set(ACTIONS) - {"then"}
    assert all(acts_said(f"please {name}") == (name,) for name in said._MORE)


def test_no_caption_takes_long() -> None:
    """Every repeat is bounded: a hundred thousand words are read in one go, and none is found."""
    assert not any("*" in words or ")+" in words for words in said._MORE.values())
    assert acts_said("take pick hit " * 33_000) == ()


@pytest.mark.parametrize(
    ("caption", "acts"),
    [
        ("She waved goodbye to the ferry.", ("wave",)),
        ("the senator turns his back on the crowd", ("turn",)),
        ("he bends his knees and comes back up", ()),
        ("she backs away from the bear", ("walk",)),
        ("took two quick steps", ("walk",)),
        ("pick the coin up", ("reach",)),
        ("walk forward and turn right", ("turn",)),
        ("wave while walking", ("wave", "walk")),
        ("left jab, right kick", ("punch", "kick")),
        ("Before he walks off, the player applauds", ("clap", "walk")),
        ("punch after kicking", ("kick", "punch")),
        ("squat, and after that jump", ("squat", "jump")),
        ("walk, pointing with the left index finger", ("walk",)),
        ("a person plays the violin", ()),
    ],
)
def test_actions_are_named_in_their_order(caption: str, acts: tuple[str, ...]) -> None:
    assert acts_said(caption) == acts


@pytest.mark.parametrize(
    ("caption", "asked"),
    [
        ("two quick squats", {"action": "squat", "count": 2, "speed": "quickly"}),
        ("hop on your left leg five times", {"action": "hop", "side": "left", "count": 5}),
        ("kick x8", {"action": "kick", "count": 8}),
        ("a dozen punches", {"action": "punch", "count": 12}),
        ("clap with two hands", {"action": "clap"}),
        ("turn 90 degrees left", {"action": "turn", "direction": "left"}),
        ("turn around seven times", {"action": "turn", "count": 7}),
        ("walk exactly nine steps", {"action": "walk", "count": 9}),
        ("walk counter-clockwise", {"action": "walk", "direction": "counterclockwise"}),
        ("walk anticlockwise", {"action": "walk", "direction": "counterclockwise"}),
        ("he backed away slowly", {"action": "walk", "direction": "backward", "speed": "slowly"}),
        ("a standing long jump", {"action": "jump", "direction": "forward"}),
        ("run fast", {"action": "run"}),
        ("hands up", {"action": "raise", "side": "both"}),
    ],
)
def test_what_is_asked_of_an_action(caption: str, asked: Record) -> None:
    [action] = acts_said(caption)
    assert {"action": action} | asked_of(caption, action) == asked


def test_who_reaches_up_may_raise_an_arm() -> None:
    assert meant_by("reach up with both arms", ("reach",)) == [("reach",), ("raise",)]
    assert meant_by("reach for the floor", ("reach",)) == [("reach",)]


def test_what_is_taken_back() -> None:
    for caption in ("don't wave", "dont wave", "nobody waves", "anything but waving", "she refused to wave"):
        assert taken_back(caption), caption
    assert not taken_back("wave like nobody is watching")


def test_other_actions_are_sentences_and_orders() -> None:
    assert "a person swims" in OTHER_ACTIONS and "swims" in OTHER_ACTIONS
    assert len(set(OTHER_ACTIONS)) == len(OTHER_ACTIONS) and all(one.strip() == one for one in OTHER_ACTIONS)
