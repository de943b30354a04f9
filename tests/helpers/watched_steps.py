"""For `MOTIONLOOM_STAGES`: every training step of a process leaves a line, as in `kill_matrix.py`."""

from __future__ import annotations

import sys

from kill_matrix import watch_steps

if "motionloom.pipeline.cluster.convert_part" not in sys.orig_argv:  # it trains nothing, and spares torch
    watch_steps()
