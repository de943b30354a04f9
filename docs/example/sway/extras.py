"""A metric, a format and a modality."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from motionloom import register
from motionloom.datasets.modalities.modality import FrameModality
from motionloom.pipeline.contract.units import Row
from motionloom.pipeline.evaluation.clip_metrics import ClipMetric, Performance
from motionloom.pipeline.evaluation.figures import Metric
from motionloom.pipeline.inference.files.writers import Outputs, Writer


def reach(performance: Performance) -> Row:
    """How far the root comes from where it begins, in metres."""
    way = performance.joints[:, 0] - performance.joints[0, 0]
    return {"sway.reach": float(np.linalg.norm(way, axis=-1).max())}


def write_csv(path: Path, outputs: Outputs) -> None:
    """A line of joint positions in metres for each frame."""
    [clip] = outputs.clips
    np.savetxt(path, clip.shown.joints.reshape(len(clip.shown.joints), -1), delimiter=",", fmt="%.4f")


class Pulse(FrameModality):
    """A heartbeat that motion goes by: sine and cosine of its phase, a row for each frame."""

    name = "pulse"
    members = ("pulse.npy",)
    width = 2


register(ClipMetric("Way of the root", reach, (Metric("sway.reach", "reach", unit="m"),)))
register(Writer("csv", ".csv", "text/csv; charset=utf-8", "joints as text", write_csv))
register(Pulse())
