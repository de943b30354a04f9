"""The beat network's training: songs with known beats, and the network that learns from them.

The trained network and its decoder are in `datasets/audio` (`beat_net.py`, `tracker.py`).
"""

from motionloom.pipeline.stages.networks.beats import songs, stage

__all__ = ["songs", "stage"]
