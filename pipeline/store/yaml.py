"""YAML as recipes are written and read: plain data only, numbers as in YAML 1.2.

PyYAML follows YAML 1.1, where `1e-4` is text, `010` is eight, `1:30` is ninety and `no` is false. The core
schema of 1.2 (section 10.3.2 of its specification) has none of these surprises. Tags other than the standard
ones are refused, as in `yaml.safe_load`.

Not ruamel.yaml: as 1.2 it still reads `1_000` and `0b1` as numbers and `2026-11-22` as a date, so it needs
resolvers of our own too, and is one more requirement.
"""

from __future__ import annotations

import json
import re
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any

import yaml

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import MOST

_CORE = (
    ("bool", re.compile(r"true|True|TRUE|false|False|FALSE"), "tTfF"),
    ("int", re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+"), "-+0123456789"),
    (
        "float",
        re.compile(
            r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"
        ),
        "-+.0123456789",
    ),
    ("null", re.compile(r"~|null|Null|NULL|"), ["~", "n", "N", ""]),
    ("merge", re.compile(r"<<"), "<"),
)
"""Tag, what is of that kind, and the characters it may begin with; `<<` is 1.1's, and handy in recipes."""


_TAG = "tag:yaml.org,2002:"
_PLAIN = ("null", "bool", "int", "float", "str", "seq", "map")
"""Types that JSON has too; the standard's sets, dates, bytes and pairs are none."""


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 - PyYAML's own
    yaml_constructors = {  # noqa: RUF012 - PyYAML's own
        tag: make
        for tag, make in yaml.SafeLoader.yaml_constructors.items()
        if tag is None or tag.removeprefix(_TAG) in _PLAIN
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """Refuse a key that is written twice, of which PyYAML would keep the last; `<<` may repeat keys.
        A key that is no text, such as a number, is the name of nothing.
        """
        seen: dict[tuple[str, str], int] = {}
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag == f"{_TAG}merge":
                continue
            line = key.start_mark.line + 1
            name = (key.tag, key.value)
            if name in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key '{key.value}' is in line {seen[name]} already; keep one", key.start_mark
                )
            seen[name] = line
        made = super().construct_mapping(node, deep)  # which has put what `<<` brings into the node
        for key, _ in node.value:
            if key.tag != f"{_TAG}str":
                what = key.value if isinstance(key, yaml.ScalarNode) else "a list or a mapping"
                raise yaml.constructor.ConstructorError(
                    None,
                    None,
                    f"key '{what}' is no text; write a name, or '{what}' in quotes",
                    key.start_mark,
                )
        return made


class _Dumper(yaml.SafeDumper):
    """Quotes every text that either version would take for something else."""


def _text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    """Text of several lines as a block, where YAML allows it."""
    return dumper.represent_scalar(f"{_TAG}str", text, style="|" if "\n" in text else None)


def _int(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int:
    text = str(loader.construct_scalar(node))
    value = int(text, 0) if text[:2] in ("0o", "0x") else int(text)
    if not -(2**63) <= value < 2**63:
        raise ValueError(f"{text:.20} is beyond 64 bits")
    return value


for _kind, _pattern, _first in _CORE:
    _whole = re.compile(rf"(?:{_pattern.pattern})\Z")
    _Loader.add_implicit_resolver(f"{_TAG}{_kind}", _whole, list(_first))
    _Dumper.add_implicit_resolver(f"{_TAG}{_kind}", _whole, list(_first))
_Dumper.add_representer(str, _text)
_Loader.add_constructor(f"{_TAG}int", _int)


_MOST_BYTES, _MOST_VALUES = 100_000, 20_000
"""Limits of a file, and of what its aliases stand for; the longest resolved recipe has 15,000 bytes."""


def load_yaml(text: str, where: str) -> Any:
    """Plain data from YAML; a `UserError` names `where` (a file or an option)."""
    if len(text) > _MOST_BYTES:
        raise UserError(f"{where}: longer than {_MOST_BYTES:,} characters, which no recipe needs; shorten it")
    try:
        data = yaml.load(text, Loader=_Loader)
    # ValueError, LookupError: what its explicit tag does not allow. RecursionError: thousands of brackets.
    except (yaml.YAMLError, ValueError, LookupError, RecursionError) as error:
        reason = " ".join(str(error).split()).replace('in "<unicode string>", ', "at ")
        raise UserError(f"{where}: not valid YAML: {reason}") from None
    _require_few(data, where)
    return data


def _require_few(data: object, where: str) -> None:
    """Refuse aliases of aliases, which stand for more values than fit in memory."""
    todo = [data]
    count = 0
    while todo:
        value = todo.pop()
        count += 1
        if count > _MOST_VALUES:
            raise UserError(
                f"{where}: holds more than {_MOST_VALUES:,} values; write fewer stages or aliases"
            )
        if isinstance(value, dict | list):
            todo += value.values() if isinstance(value, dict) else value


def read_yaml(path: Path) -> Any:
    """Plain data from a YAML file."""
    if path.exists() and not path.is_file():
        raise UserError(f"{path}: is no plain file")
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(_MOST_BYTES + 1)
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not valid YAML: {error}") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    return load_yaml(text, str(path))


def dump_yaml(data: object) -> str:
    """YAML of plain data, in its order; reading it again gives equal data."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100)


def merge(base: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    """`change` over `base`, mappings key by key; neither is altered."""
    out = dict(base)
    for key, value in change.items():
        old = out.get(key)
        out[key] = merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return out


def flatten(settings: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """`{"train": {"steps": 5}}` as `{"train.steps": 5}`; lists stay whole."""
    out: dict[str, object] = {}
    for key, value in settings.items():
        name = f"{prefix}.{key}" if prefix else str(key)
        if isinstance(value, Mapping) and value:
            out |= flatten(value, name)
        else:
            out[name] = value
    return out


def require_counts(settings: object, name: str = "") -> None:
    """`ValueError` naming a whole number beyond `MOST` among settings and groups of them: nobody has so many
    of anything, and a plan would take them for true. A seed may have 63 bits.
    """
    if isinstance(settings, Mapping):
        for key, value in settings.items():
            require_counts(value, f"{name}.{key}".removeprefix("."))
    elif isinstance(settings, list | tuple):
        for value in settings:
            require_counts(value, name)
    elif isinstance(settings, int) and settings > (2**63 - 1 if name.endswith("seed") else MOST):
        raise ValueError(f"{name} = {settings}: at most {MOST:,.0f} of anything; give a smaller number")


def setting_text(value: object) -> str:
    """Return a value as a recipe writes it, on one line."""
    if isinstance(value, str):
        return value or "(empty)"
    if value is None:
        return "null"
    if isinstance(value, list) and all(isinstance(one, str | int | float) for one in value):
        return "[" + ", ".join(str(one) for one in value) + "]"
    if isinstance(value, float):
        return f"{value:g}"
    return json.dumps(value, ensure_ascii=False)
