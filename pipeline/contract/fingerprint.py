"""What of a stage's config its fingerprint holds, and the marks of fields that it does not."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel
from pydantic.config import JsonDict

RUNTIME: JsonDict = {"runtime": True}
"""Marks a config field that changes how a stage runs, not what it makes: it is not fingerprinted."""

LATER: JsonDict = {"later": True}
"""Marks a config field that is newer than finished runs: its default is what they were made with, and is not
fingerprinted, so that they stay finished."""


def fingerprint_fields(config: BaseModel) -> dict[str, Any]:
    """The config as plain data without the fields marked RUNTIME, and those marked LATER at their default."""
    out: dict[str, Any] = {}
    for name, info in type(config).model_fields.items():
        extra = info.json_schema_extra
        if isinstance(extra, dict) and extra.get("runtime"):
            continue
        value = getattr(config, name)
        if isinstance(extra, dict) and extra.get("later") and value == info.default:
            continue
        out[name] = fingerprint_fields(value) if isinstance(value, BaseModel) else value
    return out
