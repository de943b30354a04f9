"""For `MOTIONLOOM_STAGES`: every training step of a process leaves a line, see `step_records.py`."""

from __future__ import annotations

import sys

from step_records import watch_steps

if "motionloom.pipeline.runs.convert_part" not in sys.orig_argv:  # it trains nothing, and spares torch
    watch_steps()
