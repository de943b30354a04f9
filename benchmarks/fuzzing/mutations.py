"""Damage that goes deep: bytes, text, JSON and YAML by their structure, and binary formats whose lengths and
checksums are made right again afterwards (`sealed.py`).

A mutator takes (random, content, another genuine content of the same kind) and returns damaged content.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from random import Random
from typing import Any

import yaml

Mutator = Callable[[Random, bytes, bytes], bytes]

_EDGES = [*range(4), 7, 8, 15, 16, 127, 128, 254, 255, 256, 511, 4095, 32767, 32768, 65535, 65536]
_EDGES += [2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**62, 2**63 - 1, 2**63, 2**64 - 1]
NUMBERS = [
    "0",
    "-0",
    "-1",
    "1",
    "2",
    "0.0",
    "1e-320",
    "1e308",
    "1e309",
    "-1e308",
    "1e20",
    "1e9",
    "1e10",
    "nan",
    "NaN",
    "inf",
    "-inf",
    "Infinity",
    "-Infinity",
    "99999999999999999999",
    "-9223372036854775808",
    "9223372036854775808",
    "0x10",
    "1_000",
    "1.",
    ".5",
    "1e",
    "+1",
    "١٢",
    "1,5",
    "5e-5",
    "010",
    "1e-400",
]
NUMBERS += ["1" * 400, "0." + "1" * 400, "1" * 5000]
WORDS = [
    "",
    " ",
    "\t",
    "\0",
    "\x1b[31m",
    "\u202e",
    "\ufeff",
    "\u2028",
    "\r",
    "\x85",
    "x" * 3000,
    "a" * 300 + ".bvh",
]
WORDS += [
    "é",
    "😀",
    "..",
    ".",
    "../x",
    "/etc/passwd",
    "a/../../b",
    "C:\\x",
    "~",
    "null",
    "true",
    "[]",
    "{}",
    "'",
    '"',
    "<script>",
    "%s%n",
    "{0}",
    "#",
    "-",
    "NaN",
    "\\",
    "*",
    "&a",
    "<<",
    "s3://bucket/x",
    "http://127.0.0.1:9/x",
    "file:///etc/passwd",
    "con",
    "None",
    "!!python/name:os.system",
]


def damaged_bytes(random: Random, data: bytes, other: bytes) -> bytes:
    """One to four of: bits, bytes, words of numbers, cuts, repeats, and pieces of another file."""
    out = bytearray(data)
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        at = random.randrange(len(out) + 1)
        length = min(random.choice((1, 2, 4, 8, 16, 64, 512, 4096)), max(1, len(out)))
        match random.randrange(10):
            case 0 | 1 if out:
                out[min(at, len(out) - 1)] ^= 1 << random.randrange(8)
            case 2 if out:
                out[min(at, len(out) - 1)] = random.choice((0, 1, 127, 128, 255, random.randrange(256)))
            case 3:
                size = random.choice((2, 4, 8))
                value = random.choice(_EDGES) % 2 ** (8 * size)
                out[at : at + size] = value.to_bytes(size, random.choice(("little", "big")))
            case 4:
                del out[at : at + length]
            case 5:
                out[at:at] = out[at : at + length] * random.choice((1, 2, 40))
            case 6:
                out[at:at] = random.randbytes(min(length, 64))
            case 7:
                start = random.randrange(len(other) + 1)
                out[at : at + length] = other[start : start + length]
            case 8:
                del out[at:]
            case _:
                out[at : at + length] = bytes([random.choice((0, 32, 255))]) * length
        del out[4_000_000:]
    return bytes(out)


_TOKEN = re.compile(r"[^\s,:;\[\]{}\"'#|=]+")


def damaged_text(random: Random, data: bytes, other: bytes) -> bytes:
    """Lines and words exchanged, repeated, left out; numbers that are none, and letters that do things."""
    lines = data.decode("utf-8", "surrogateescape").split("\n")
    others = other.decode("utf-8", "surrogateescape").split("\n")
    for _ in range(random.choice((1, 1, 2, 3, 6))):
        at = random.randrange(len(lines))
        match random.randrange(12):
            case 0:
                del lines[at : at + random.choice((1, 1, 3, 20))]
            case 1:
                lines[at:at] = lines[at : at + random.choice((1, 2, 8))] * random.choice((1, 1, 3, 50))
            case 2:
                to = random.randrange(len(lines))
                lines[at], lines[to] = lines[to], lines[at]
            case 3:
                lines[at] = random.choice(others)
            case 4:
                lines[at] = lines[at][: random.randrange(len(lines[at]) + 1)]
            case 5:
                return damaged_bytes(random, "\n".join(lines).encode("utf-8", "surrogateescape"), other)
            case 6:
                word = random.choice((random.choice(WORDS), random.choice(NUMBERS)))
                lines[at:at] = [word * random.choice((1, 1, 30))]
            case 7:
                place = random.randrange(len(lines[at]) + 1)
                lines[at] = lines[at][:place] + random.choice(WORDS) + lines[at][place:]
            case _:
                tokens = list(_TOKEN.finditer(lines[at][:100_000]))
                if tokens:
                    token = random.choice(tokens)
                    lines[at] = (
                        lines[at][: token.start()] + _word_for(random, token[0]) + lines[at][token.end() :]
                    )
        lines = lines[:50_000] or [""]
    end = random.choice(("\n",) * 12 + ("\r\n", "\r"))
    mark = random.choice((b"",) * 20 + (b"\xef\xbb\xbf", b"\xff\xfe"))
    return (
        mark
        + end.join(lines).encode("utf-8", "surrogatepass" if random.random() < 0.1 else "replace")[:4_000_000]
    )


def _word_for(random: Random, word: str) -> str:
    try:
        value = float(word)
    except ValueError:
        return random.choice(
            (random.choice(WORDS), random.choice(NUMBERS), word * 2, word[:-1], word.upper())
        )
    if random.random() < 0.5:
        return random.choice(NUMBERS)
    near = random.choice(
        (value + 1, value - 1, -value, value * 1e3, value * 1e-3, value * 1e9, value + 0.5, value * 2)
    )
    return f"{near:g}" if not math.isfinite(near) or near % 1 or random.random() < 0.3 else f"{int(near)}"


# JSON and YAML: values by their place.

_VALUES: list[Any] = [
    None,
    True,
    False,
    0,
    -1,
    1,
    2,
    1.5,
    -0.0,
    1e308,
    1e-320,
    2**31,
    2**53 + 1,
    2**63,
    10**20,
]
_VALUES += [10**400, "", "x", "0", "1", "nan", [], {}, [[]], [None], [{}], {"": None}, {"a": 1}, [0] * 500]
_VALUES += [
    {str(k): k for k in range(200)},
    *WORDS,
    math.nan,
    math.inf,
    ["a", 1, None],
    "\ud800",
    {"text": None},
]
_VALUES += [{"text": 5}, [1e300, -1e300], 10**9, 10**12]


def damaged_value(random: Random, value: Any, depth: int = 0) -> Any:
    """A value with one place in it changed: another value or kind, a key more or less, a list longer."""
    if isinstance(value, dict | list) and value and (random.random() < 0.85 or depth == 0) and depth < 40:
        keys = list(value) if isinstance(value, dict) else list(range(len(value)))
        key = random.choice(keys)
        inner = random.random()
        out = dict(value) if isinstance(value, dict) else list(value)
        if inner < 0.7:
            out[key] = damaged_value(random, value[key], depth + 1)
        elif inner < 0.78:
            del out[key]
        elif inner < 0.84:
            if isinstance(out, list):
                out += [value[key]] * random.choice((1, 3, 300))
            else:
                out[random.choice((f"{key}x", str(key).upper(), *WORDS[:8]))] = value[key]
        elif inner < 0.9 and isinstance(out, dict):
            out[str(random.choice(keys))] = out.pop(key)
        elif inner < 0.95:
            out[key] = value[random.choice(keys)]
        else:
            out[key] = [value[key]] if random.random() < 0.5 else {"a": value[key]}
        return out
    if isinstance(value, bool) or value is None:
        return random.choice((*_VALUES, not value))
    if isinstance(value, int | float) and abs(value) < 10**30 and random.random() < 0.6:
        return random.choice(
            (value + 1, value - 1, -value, value * 2, value * 1000, value * 10**9, f"{value}", [value])
        )
    if isinstance(value, str) and value and random.random() < 0.5:
        return random.choice(
            (
                value[:-1],
                value + random.choice(WORDS),
                value * 50,
                value.upper(),
                [value],
                value[::-1],
                {"a": value},
            )
        )
    return random.choice(_VALUES)


def damaged_json(random: Random, data: bytes, other: bytes) -> bytes:
    """JSON with places changed, or its text; keys twice, endless depth, numbers that JSON does not know."""
    if random.random() < 0.2:
        return damaged_text(random, data, other)
    try:
        value = json.loads(data)
    except ValueError:
        return _damaged_lines(random, data, other)
    for _ in range(random.choice((1, 1, 2, 3))):
        value = damaged_value(random, value)
    text = json.dumps(value, ensure_ascii=random.random() < 0.7)
    if random.random() < 0.06:
        deep = random.choice((50, 900, 20_000))
        mark = random.choice(("[", '{"a":'))
        place = random.randrange(len(text) + 1)
        text = text[:place] + mark * deep + text[place:]
    if random.random() < 0.05 and (keys := re.findall(r'"[^"\\]{1,30}":', text)):
        key = random.choice(keys)
        text = text.replace(key, f"{key} 1, {key}", 1)
    return text.encode("utf-8", random.choice(("replace", "replace", "surrogatepass")))


def _damaged_lines(random: Random, data: bytes, other: bytes) -> bytes:
    """JSON lines with one of them changed."""
    lines = data.split(b"\n")
    at = random.randrange(len(lines))
    try:
        value = json.loads(lines[at])
    except ValueError:
        return damaged_text(random, data, other)
    lines[at] = json.dumps(damaged_value(random, value), ensure_ascii=random.random() < 0.7).encode(
        "utf-8", "replace"
    )
    if random.random() < 0.3:
        lines.insert(random.randrange(len(lines)), random.choice(lines))
    return b"\n".join(lines)


_ODD_KEYS: tuple[Any, ...] = (
    3,
    1.5,
    True,
    None,
    -1,
    10**20,
    math.nan,
    "",
    "3",
    "<<",
    "x" * 300,
    "é",
    "a.b",
    "null",
)
_MARKS = (
    "&a ",
    "*a",
    "!!str ",
    "!!int ",
    "!!python/object/apply:os.system ",
    "<<: ",
    "? ",
    "!!set ",
    "- ",
    "| \n",
    "!!binary ",
    "!!timestamp ",
    "%YAML 1.1\n---\n",
    "---\n",
    "!!float ",
    "!x ",
    "{",
    "[",
    "}",
    "]",
)


def damaged_yaml(random: Random, data: bytes, other: bytes) -> bytes:
    """YAML with places changed, also its keys; with anchors, tags and merges, or as text."""
    if random.random() < 0.25:
        return damaged_text(random, data, other)
    value = yaml.safe_load(data)
    for _ in range(random.choice((1, 1, 2, 3))):
        value = _odd_key(random, value) if random.random() < 0.3 else damaged_value(random, value)
    text: str = yaml.safe_dump(value, allow_unicode=True, sort_keys=False)
    if random.random() < 0.25:
        place = random.randrange(len(text) + 1)
        text = text[:place] + random.choice(_MARKS) + text[place:]
    return text.encode("utf-8", "replace")


def _odd_key(random: Random, value: Any) -> Any:
    """A mapping somewhere in a value with a key that is no text, or another one."""
    if not isinstance(value, dict):
        return {random.choice(_ODD_KEYS): value}
    inner = [key for key, one in value.items() if isinstance(one, dict)]
    if inner and random.random() < 0.75:
        key = random.choice(inner)
        return {**value, key: _odd_key(random, value[key])}
    return {**value, random.choice(_ODD_KEYS): random.choice((1, "x", None, {}, [1], {3: 4}))}
