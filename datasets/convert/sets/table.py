"""The converters of published sets beside the papers' own: which module registers each."""

from __future__ import annotations

from motionloom.datasets.base.register import declare

_SETS = ("amass", "beat2", "bones_seed", "finedance", "motion272", "motionhub", "snapmogen", "style100")

declare("converter", {name: f"motionloom.datasets.convert.sets.{name}" for name in _SETS})
