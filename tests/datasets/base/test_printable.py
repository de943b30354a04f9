"""Text of strangers on a terminal."""

from __future__ import annotations

import pytest

from motionloom.datasets.base.printable import printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("walks\r\nfast\t", r"walks\r\nfast\t"),
        ("\x1b]0;owned\x07\x9b31m", r"\x1b]0;owned\x07\x9b31m"),
        ("left\u202egpj.exe", r"left\u202egpj.exe"),
        ("\ud800", r"\ud800"),
        ("跳舞\u3000Tänzer می\u200cرقصد 👩\u200d🚀\xa0é", "跳舞\u3000Tänzer می\u200cرقصد 👩\u200d🚀\xa0é"),
    ],
)
def test_no_character_commands_a_terminal_and_every_script_stays(text: str, shown: str) -> None:
    assert printable(text) == shown
