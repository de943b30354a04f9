"""What of a config decides what a stage makes: all but the fields that are marked RUNTIME."""

from __future__ import annotations

from pydantic import BaseModel
from pydantic.config import JsonDict

RUNTIME: JsonDict = {"runtime": True}
"""Marks a config field that changes how a stage runs, not what it makes: it is not fingerprinted."""


def fingerprint_fields(config: BaseModel) -> dict[str, object]:
    """The config as plain data without the fields marked RUNTIME."""
    out: dict[str, object] = {}
    for name, info in type(config).model_fields.items():
        extra = info.json_schema_extra
        if isinstance(extra, dict) and extra.get("runtime"):
            continue
        value = getattr(config, name)
        out[name] = fingerprint_fields(value) if isinstance(value, BaseModel) else value
    return out
