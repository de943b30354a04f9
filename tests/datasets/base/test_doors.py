"""Numbers and text from outside come through one door each: JSON, tables, times and weights of others."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import math
import os
import pkgutil
import re
import re._constants as sre
import re._parser as sre_parser
from collections.abc import Callable, Iterator
from itertools import takewhile
from pathlib import Path
from typing import Any

import pytest
import torch
from annotated_types import Ge, Gt, Le, Lt
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from safetensors.torch import save_file

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import number, parse_json, whole
from motionloom.datasets.convert.captions.humanml_text import parse_caption
from motionloom.pipeline.contract.stage import stage_kinds
from motionloom.pipeline.editing.task import EditTask
from motionloom.pipeline.results.paper.schema import Bounds
from motionloom.pipeline.store.weights import exact_tensors, load_weights

ROOT = Path(__file__).parents[3]
FLOATS = ("float32", "float16", "bfloat16", "float64")
FOLDERS = (
    "pipeline/inference/clip_file.py",
    "datasets/convert",
    "datasets/shards",
    "pipeline/serve",
    "pipeline/editing",
)
LETTERS = st.text(st.characters(exclude_categories=()), max_size=6)
LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | LETTERS
VALUES = st.recursive(LEAVES, lambda inner: st.lists(inner) | st.dictionaries(LETTERS, inner), max_leaves=8)


def configs(base: type[Config]) -> Iterator[type[Config]]:
    """Every config of every stage, and what else has been imported."""
    assert list(stage_kinds().values())
    for kind in base.__subclasses__():
        if kind.__module__.startswith("motionloom"):  # no other test's
            yield from (kind, *configs(kind))


def fine(value: Any) -> bool:
    if isinstance(value, dict):
        return all(fine(key) and fine(one) for key, one in value.items())
    if isinstance(value, list):
        return all(map(fine, value))
    if isinstance(value, str):
        return not any("\ud800" <= letter <= "\udfff" for letter in value)
    if isinstance(value, float):
        return math.isfinite(value)
    return value is None or -(2**63) <= value < 2**63


@settings(max_examples=400, deadline=None)
@given(VALUES, st.booleans())
def test_json_is_finite_of_64_bits_and_whole_letters(value: Any, escaped: bool) -> None:
    text = json.dumps(value, ensure_ascii=escaped)
    if fine(json.loads(text)):
        assert parse_json(text, "x") == json.loads(text)
    else:
        with pytest.raises(UserError, match=r"^x: not valid JSON"):
            parse_json(text, "x")


@settings(max_examples=300, deadline=None)
@given(
    st.floats().map(repr) | st.integers().map(str) | st.text(max_size=8) | st.sampled_from(["²", "9" * 5000])
)
def test_fields_are_numbers_within_their_bounds(text: str) -> None:
    for read in (number, whole):
        try:
            found = read(text, "x", 100)
        except UserError as error:
            # Twenty characters of it at most, each escaped where it is not printable.
            assert str(error).startswith("x: ") and len(str(error)) < 60 + 20 * len(r"\U0002ebe1")
        else:
            assert 0 <= found <= 100 and found == float(text)


@settings(max_examples=200, deadline=None)
@given(
    st.floats() | st.sampled_from([1e308, 3600.5]), st.sampled_from(["lead", "start", "end", "path", "pins"])
)
def test_times_are_an_hour_at_most(seconds: float, key: str) -> None:
    pin = {"at": seconds, "joint": "head", "position": [0, 1, 0]}
    path = [{"at": seconds, "x": 0, "z": 0}]
    task = {"lead": {key: seconds}, "path": {key: path}, "pins": {key: [pin]}}.get(
        key, {"keep": [{key: seconds}]}
    )
    try:
        EditTask.parse(task, "task")
    except UserError:
        assert not 0 < seconds <= 3600
    else:
        assert abs(seconds) <= 3600 and (seconds >= 0 or key in ("path", "pins"))


def test_no_setting_is_infinite_and_none_has_two_bounds_of_a_kind() -> None:
    """Each number of each config is tried. The last of two bounds would count alone."""
    tried = 0
    for config in (one for one in configs(Config) if not inspect.isabstract(one)):
        for name, field in config.model_fields.items():
            bounds = [type(one) for one in field.metadata if isinstance(one, (Ge, Gt, Le, Lt))]
            assert len(bounds) == len(set(bounds)), f"{config.__name__}.{name}"
            if field.annotation in (float, float | None) and config is not Bounds:
                for value in (math.inf, -math.inf, math.nan):
                    tried += 1
                    with pytest.raises(ValidationError) as error:
                        config(**{name: value})
                    found = {one["loc"][0] for one in error.value.errors()}
                    assert name in found, f"{config}.{name} = {value}"
    assert tried > 200


@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from([*FLOATS, "int8", "uint8", "int64", "bool", "complex64", "float8_e4m3fn"]), st.floats()
)
def test_weights_are_floats_and_finite_as_they_are_taken(
    tmp_path_factory: pytest.TempPathFactory, kind: str, value: float
) -> None:
    path = tmp_path_factory.getbasetemp() / "model.safetensors"
    whole_number = not kind.startswith(("float", "bfloat", "complex"))
    made = torch.tensor([[0 if whole_number else value]], dtype=torch.float64).to(getattr(torch, kind))
    save_file({"weight": made}, path)
    net = torch.nn.Linear(1, 1, bias=False)
    reads: list[Callable[[], object]] = [
        lambda: exact_tensors(path, {"weight": (1, 1)}, "x"),
        lambda: load_weights(path.parent, net),
    ]
    for read in reads:
        if kind in FLOATS and bool(made.float().isfinite()):
            read()
        else:
            with pytest.raises(UserError, match=r"model\.safetensors: .*'weight'"):
                read()
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(UserError, match="not a plain file"):
        load_weights(path.parent, net)
    path.unlink()


KNOWN = {"float(scaling[0])", "float(_BALL[2])", "float(_BALL[1])", "float(bones)", "int(index)", "int(rate)",
         "float(value)", "int(count)", "int(turn[0])", "int(bad[0])", "int(parent)"}  # fmt: skip
"""Known uses on numbers; `facts.py` takes what is no number as words."""


@pytest.mark.parametrize("folder", FOLDERS)
def test_text_becomes_a_number_at_the_door(folder: str) -> None:
    for path in sorted((ROOT / folder).rglob("*.py")) or [ROOT / folder]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            where = f"{path.name}:{getattr(node, 'lineno', 0)}: {ast.unparse(node)[:80]}"
            assert not (isinstance(node, ast.Attribute) and node.attr == "isdigit"), where
            if not (isinstance(node, ast.Call) and ast.unparse(node.func) in ("int", "float") and node.args):
                continue
            given = node.args[0]
            field = isinstance(given, ast.Subscript) and isinstance(given.value, ast.Name)
            text = isinstance(given, ast.Call) and ast.unparse(given.func).endswith(
                ("str", "strip", "get", "group")
            )
            bare = isinstance(given, ast.Name) or text or (field and isinstance(given.slice, ast.Constant))
            assert not bare or ast.unparse(node) in KNOWN, where


REPEATS = (sre.MAX_REPEAT, sre.MIN_REPEAT, sre.POSSESSIVE_REPEAT)


def slow_parts(pattern: str | bytes, flags: int, *, searched: bool) -> int:
    """Parts of a pattern that may look at the letters of a line once for each letter: a repeat at the start
    of one that is searched for, at any letter, and further repeats that take what the first one does.
    """
    parts = list(flat(sre_parser.parse(pattern, flags)))
    endless = [op in REPEATS and arg[1] is sre.MAXREPEAT for op, arg in parts]
    wide = 0
    for at, (_, arg) in enumerate(parts):
        if endless[at]:
            kind, taken = arg[2][0]
            after = parts[at + 1 : at + 2]
            any_but_one = kind is sre.NOT_LITERAL and after == [(sre.LITERAL, taken)]
            most = kind is sre.ANY or (kind is sre.IN and taken[0] == (sre.CATEGORY, sre.CATEGORY_NOT_SPACE))
            # What one repeat may leave to the next, with nothing certain between them.
            rest = list(takewhile(lambda part: part[0] in REPEATS and not part[1][0], parts[at + 1 :]))
            shared = [
                part for part in rest if part[1][1] is sre.MAXREPEAT and (most or [*part[1][2]] == [*arg[2]])
            ]
            wide += 2 * bool(shared and parts[at][0] is not sre.POSSESSIVE_REPEAT)
            wide += most or (kind is sre.NOT_LITERAL and not any_but_one)
    return (searched and endless[0] and len(parts) > 1) + max(0, wide - 1)


def flat(parsed: Any) -> Iterator[tuple[Any, Any]]:
    for op, arg in parsed:
        yield from flat(arg[3]) if op is sre.SUBPATTERN else [(op, arg)]


def test_no_pattern_looks_at_long_lines_once_for_each_letter() -> None:
    """By their form, without a clock: `_PLACE` is of words of the command line, `_HEADER` of two lines."""
    for slow in (r".*[:|/]", r"\s+and", r"[^#].*#.*#\d", r"\S*/\S*", r"@\d*-?\d*", r"_.+?(?:_\d+)*"):
        assert slow_parts(slow, 0, searched=True)
    seen = 0
    for folder in ("audio", "convert", "motion", "text"):
        room = importlib.import_module(f"motionloom.datasets.{folder}")
        for found in pkgutil.walk_packages(room.__path__, f"{room.__name__}."):
            module = importlib.import_module(found.name)
            source = inspect.getsource(module)
            for name, value in vars(module).items():
                searched = re.search(rf"\b{name}\.(search|sub|split|findall|finditer)\b", source) is not None
                for one in value.values() if isinstance(value, dict) else [value]:
                    if isinstance(one, re.Pattern) and name not in ("_PLACE", "_HEADER"):
                        seen += 1
                        assert not slow_parts(one.pattern, one.flags, searched=searched), (found.name, name)
    assert seen > 30
    with pytest.raises(UserError, match="1001 of the 4"):
        parse_caption("a person walks" + "#" * 1000, seconds=None)
