"""The command of this folder: which module registers it."""

from __future__ import annotations

from motionloom.datasets.base.register import declare

declare("command", {"launch": "motionloom.pipeline.runs.cluster.command"})
