"""The command of this folder: which module registers it."""

from __future__ import annotations

from motionloom.datasets.base.register import declare

declare("command", {"serve": "motionloom.pipeline.serve.command"})
