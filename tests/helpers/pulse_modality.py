"""A modality in one file: a pulse that motion goes by, two numbers a frame.

`tests/pipeline/contract/test_new_modality.py` adds its line to the table; nothing else knows of it.
"""

from __future__ import annotations

from motionloom.datasets.modalities.modality import FrameModality


class PulseModality(FrameModality):
    """A heartbeat's phase, as sine and cosine."""

    name = "pulse"
    members = ("pulse.npy",)
    width = 2


PULSE = PulseModality()
