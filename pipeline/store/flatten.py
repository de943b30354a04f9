"""Settings as dotted keys and short texts, for tables that people read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


def flatten(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """`{"train": {"steps": 5}}` as `{"train.steps": 5}`; lists stay whole."""
    out: dict[str, Any] = {}
    for key, value in settings.items():
        name = f"{prefix}.{key}" if prefix else str(key)
        if isinstance(value, Mapping) and value:
            out |= flatten(value, name)
        else:
            out[name] = value
    return out


def setting_text(value: Any) -> str:
    """As it would stand in a recipe, on one line."""
    if isinstance(value, str):
        return value or "(empty)"
    if value is None:
        return "null"
    if isinstance(value, list) and all(isinstance(one, str | int | float) for one in value):
        return "[" + ", ".join(str(one) for one in value) + "]"
    if isinstance(value, float):
        return f"{value:g}"
    return json.dumps(value, ensure_ascii=False)
