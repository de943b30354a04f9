"""Conditions on a stage: its kind, values of its config, and the stages that feed it.

{kind: gpt, where: {prior: tma, loss.align_weight: {above: 0}}, inputs: {tokenizer: {kind: h2vq}}}
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Self

from pydantic import Field, model_validator

from motionloom.datasets.schema import Config
from motionloom.pipeline.store.run_state import StageRecord

Scalar = bool | int | float | str | None


class Bounds(Config):
    """A number between bounds, themselves left out."""

    above: float | None = None
    below: float | None = None

    @model_validator(mode="after")
    def _some_bound(self) -> Self:
        if self.above is None and self.below is None:
            raise ValueError("give above, below or both")
        return self

    def holds(self, value: object) -> bool:
        """Whether `value` is a number within."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            return False
        return (self.above is None or value > self.above) and (self.below is None or value < self.below)


Condition = Bounds | list[Scalar] | Scalar
"""Of one value: bounds, any of several values, or the value itself."""


class StageMatch(Config):
    """What a stage must be."""

    kind: str | list[str]
    """Its kind, or any of several."""
    where: dict[str, Condition] = Field(default_factory=dict)
    """Dotted keys of its config, such as `net.num_codes`."""
    inputs: dict[str, StageMatch | None] = Field(default_factory=dict)
    """Role -> what fills it; null: nothing may."""

    def fits(self, stage: StageRecord) -> bool:
        """Whether `stage` is so."""
        kinds = [self.kind] if isinstance(self.kind, str) else self.kind
        return (
            stage.kind in kinds
            and config_fits(self.where, stage.config)
            and all(may_fill(match, stage.inputs.get(role)) for role, match in self.inputs.items())
        )


def may_fill(match: StageMatch | None, stage: StageRecord | None) -> bool:
    """Whether a stage, or none, is what `match` wants; None wants none."""
    if match is None or stage is None:
        return match is None and stage is None
    return match.fits(stage)


def config_fits(where: Mapping[str, Condition], config: Mapping[str, object]) -> bool:
    """Whether every condition is met. A key that the config does not have meets none."""
    return all(_meets(condition, value_at(config, key)) for key, condition in where.items())


_ABSENT = object()


def value_at(data: object, key: str, default: object = _ABSENT) -> object:
    """The value under a dotted key of nested mappings; `default` where there is none."""
    for name in key.split("."):
        if not isinstance(data, Mapping) or name not in data:
            return default
        data = data[name]
    return data


def _meets(condition: Condition, value: object) -> bool:
    if value is _ABSENT:
        return False
    if isinstance(condition, Bounds):
        return condition.holds(value)
    if isinstance(condition, list):
        return any(_same(one, value) for one in condition)
    return _same(condition, value)


def _same(one: Scalar, value: object) -> bool:
    """Equal, where true is no 1."""
    return isinstance(one, bool) == isinstance(value, bool) and bool(one == value)
