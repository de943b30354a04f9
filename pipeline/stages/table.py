"""Our own stage kinds: every file of these folders, and every baseline's `stage`, registers its kinds."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

STAGES = ("data", "networks", "results")
"""Folders beside this file."""
BASELINES = "motionloom.pipeline.baselines"
"""Found by name: nothing imports a baseline."""

for folder in STAGES:
    package = import_module(f"motionloom.pipeline.stages.{folder}")
    for module in iter_modules(package.__path__, f"{package.__name__}."):
        import_module(module.name)
for module in iter_modules(import_module(BASELINES).__path__, f"{BASELINES}."):
    import_module(f"{module.name}.stage")
