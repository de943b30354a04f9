"""For `MOTIONLOOM_STAGES`: every training step of a process leaves a line, see `step_records.py`."""

from __future__ import annotations

from step_records import watch_steps

watch_steps()
