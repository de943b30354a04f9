"""Plain decimals: bit for bit the values of `float`, and nothing else is taken for one."""

from __future__ import annotations

import random

import numpy as np
import pytest

from motionloom.datasets.motion.bvh_text import read_values
from motionloom.datasets.motion.decimal_text import parse_decimals


def parse(words: list[str]) -> np.ndarray | None:
    text = np.frombuffer(" ".join(words).encode(), dtype=np.uint8)
    ends = np.cumsum([len(word) + 1 for word in words]) - 1
    return parse_decimals(text, ends - [len(word) for word in words], ends)


def test_every_length_and_sign_gives_the_bits_of_float() -> None:
    chance = random.Random(0)
    words = [
        sign + digits(chance, whole) + "." + digits(chance, fraction)
        for whole in range(9)
        for fraction in range(9)
        for sign in ("", "-", "+")
        for _ in range(40)
        if 1 <= whole + fraction <= 15
    ]
    words += ["-0.000000", "0.", ".0", "99999999.9999999", "-.00000001"]
    chance.shuffle(words)
    got = parse(words)
    assert got is not None
    assert got.tobytes() == np.array([float(word) for word in words]).tobytes()


def digits(chance: random.Random, count: int) -> str:
    return "".join(chance.choice("0123456789") for _ in range(count))


@pytest.mark.parametrize(
    "words",
    [
        ["1"], ["1e5"], ["1.5e3"], ["--1.0"], ["1.2.3", "4"], ["1-.5"], ["a.5"], ["-."], ["+."], ["."],
        ["nan"], ["1.123456789"], ["123456789.0"], ["12345678.12345678"], ["0x1.5"], ["1.5", "2"], ["1_0.5"],
        ["1.5-"],
    ],
)  # fmt: skip
def test_anything_else_is_left_to_the_general_reader(words: list[str]) -> None:
    assert parse(["2.5", *words, "3.5"]) is None


@pytest.mark.parametrize("word", ["1e2", "-7", "12345678901.5", "0.123456789012345678"])
def test_the_reader_takes_both_kinds(word: str) -> None:
    body = f"0.5 {word} -1.25\n3.0 4.0 5.0\n".encode()
    got = read_values(body, 0, 2, 3, "clip")
    np.testing.assert_array_equal(got, [[0.5, float(word), -1.25], [3.0, 4.0, 5.0]])
