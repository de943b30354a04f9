"""Our own stage kinds: every file of the folders beside this one is imported and registers its kinds."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from motionloom.pipeline.stages import baselines, data, networks, results

for package in (data, networks, baselines, results):
    for module in iter_modules(package.__path__, f"{package.__name__}."):
        import_module(module.name)
