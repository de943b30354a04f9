"""`defaults:` of a recipe: settings that its stages share, by their kind, or `trained` for all that train.

    defaults:
      trained: {optim: {schedule: cosine}, train: {precision: bf16-mixed, batch_size: 256}}
      vq: {net: {width: 256}}

A stage's entry goes over the defaults of its kind, and those go over `trained`, key by key.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from motionloom.datasets.schema import UserError, explain
from motionloom.pipeline.contract.registry import stage_kinds
from motionloom.pipeline.contract.stage import StageConfig
from motionloom.pipeline.runs.layers import merge
from motionloom.pipeline.runs.shipped import nearest
from motionloom.pipeline.stages.train_config import TrainedStageConfig

TRAINED = "trained"
"""The defaults of every stage that trains."""

Entries = Mapping[str, dict[str, Any]]

# What a stage's own entry may complete or put right.
_ONLY_WHOLE = {"missing", "value_error"}


def fill(stages: Entries, defaults: Entries, where: str) -> dict[str, dict[str, Any]]:
    """Every stage's entry over the defaults that concern it."""
    for key, fields in defaults.items():
        _require_known(key, fields, where)
    out = {}
    for name, entry in stages.items():
        shared: dict[str, Any] = {}
        for key in _concerning(entry):
            shared = merge(shared, defaults.get(key, {}))
        out[name] = merge(shared, entry)
    return out


def require_used(keys: Any, stages: Any, where: str) -> None:
    """Refuse defaults that concern no stage; both as they were read, in whatever form."""
    entries = stages.values() if isinstance(stages, dict) else ()
    if any(isinstance(entry, dict) and "kind" not in entry for entry in entries):
        return  # they are of the kinds of the model that the recipe starts from, whatever that will be
    concerned = list(dict.fromkeys(key for entry in entries for key in _concerning(entry)))
    for key in keys or ():
        if key not in concerned and (key == TRAINED or key in stage_kinds()):
            whom = "that trains" if key == TRAINED else f"of kind {key}"
            raise UserError(f"{where}: defaults.{key} concerns no stage: there is none {whom}; leave it out")


def _concerning(entry: Any) -> list[str]:
    """The keys of `defaults` that an entry stands on, the most general first."""
    kind = stage_kinds().get(str(entry.get("kind"))) if isinstance(entry, dict) else None
    if kind is None:
        return []
    return [TRAINED, kind.name] if issubclass(kind.config, TrainedStageConfig) else [kind.name]


def _require_known(key: str, fields: dict[str, Any], where: str) -> None:
    """Refuse keys that no such stage has, and values that cannot be right in any."""
    kinds = stage_kinds()
    if key != TRAINED and key not in kinds:
        raise UserError(f"{where}: defaults.{key}: no stage kind '{key}'{nearest(key, [TRAINED, *kinds])}")
    config: type[StageConfig] = TrainedStageConfig if key == TRAINED else kinds[key].config
    try:
        config.model_validate(fields)
    except ValidationError as error:
        wrong = [item for item in error.errors() if item["type"] not in _ONLY_WHOLE]
        if wrong:
            lines = explain(error, config, f"{where}: defaults.{key}").splitlines()
            shown = [line for item, line in zip(error.errors(), lines, strict=False) if item in wrong]
            raise UserError("\n".join(shown)) from None
