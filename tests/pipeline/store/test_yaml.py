"""YAML: numbers as the 1.2 core schema has them, plain data only, and what is written reads the same."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.store.yaml import dump_yaml, load_yaml, read_yaml

CORE: list[tuple[str, Any]] = [
    # The examples of the specification (YAML 1.2.2, 10.3.2), and what version 1.1 made of something else.
    ("null", None), ("", None), ("~", None),
    ("true", True), ("True", True), ("false", False), ("FALSE", False),
    ("0", 0), ("0o7", 7), ("0x3A", 0x3A), ("-19", -19),
    ("0.", 0.0), ("-0.0", -0.0), (".5", 0.5), ("+12e03", 12000.0), ("-2E+05", -200000.0),
    (".inf", math.inf), ("-.Inf", -math.inf), ("+.INF", math.inf),
    ("1e-4", 1e-4), ("1E5", 1e5), ("010", 10), ("1:30", "1:30"), ("1_000", "1_000"),
    ("no", "no"), ("Yes", "Yes"), ("on", "on"), ("2026-11-22", "2026-11-22"), ("e5", "e5"), ("1e", "1e"),
    ("'1e-4'", "1e-4"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "want"), CORE)
def test_scalars_are_those_of_the_core_schema(text: str, want: Any) -> None:
    found = load_yaml(f"- {text}", "here")[0]
    assert (type(found), found) == (type(want), want)
    assert math.isnan(load_yaml(".NaN", "here"))


ODD_KEYS = ["3: 4", "a: {true: 4}", "null: 4", "- {1.5: 2}", "? [a]\n: 4", "<<: {3: 4}", "? !!int 3\n: 4"]
ODD_VALUES = [f"!!{tag}" for tag in ("timestamp 2026-01-01", "set {a}", "binary YQ==", "omap [a: 1]")]


@pytest.mark.parametrize("text", ["!made x", "a: [", "a: b: c", str(2**63), *ODD_KEYS, *ODD_VALUES])
def test_tags_and_broken_text_are_refused_by_name(text: str) -> None:
    with pytest.raises(UserError, match="recipe: "):
        load_yaml(text, "recipe")


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"none\.yaml: "):
        read_yaml(tmp_path / "none.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"a: \xe9")
    with pytest.raises(UserError, match=r"latin\.yaml: "):
        read_yaml(tmp_path / "latin.yaml")


# PyYAML itself folds the rarer line breaks (U+0085, U+2028) of a text; names and captions have none.
TEXT = st.text(
    st.characters(exclude_categories=["Cs", "Cc", "Zl", "Zp"], exclude_characters="\ufeff"), max_size=9
)
PLAIN = st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | TEXT
LIKE_OTHERS = st.sampled_from([text.strip("'") for text, _ in CORE] + ["<<", "=", "0b1", "12e03"])


@settings(max_examples=300, deadline=None)
@given(st.dictionaries(TEXT | LIKE_OTHERS, PLAIN | LIKE_OTHERS | st.lists(PLAIN, max_size=3)))
def test_what_is_written_reads_the_same(data: dict[str, Any]) -> None:
    assert load_yaml(dump_yaml(data), "here") == data


@given(st.dictionaries(st.sampled_from("abc"), LIKE_OTHERS))
def test_readers_of_version_1_1_find_the_same_texts(data: dict[str, str]) -> None:
    assert yaml.safe_load(dump_yaml(data)) == data
