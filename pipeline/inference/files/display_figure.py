"""The figure that all outputs show of a generated motion: one rigid skeleton, its feet planted.

Page, BVH, GLB and npz take it from here, so they show the same. Evaluation and metrics never
do: they read the features' own joints (`GeneratedMotion.joints`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from motionloom.datasets.base.config import Config
from motionloom.datasets.motion.body.feet import FeetReport, foot_contacts, plant_feet
from motionloom.datasets.motion.body.rigid import RigidMotion, fit_rigid
from motionloom.datasets.motion.features.joints import rotations_of
from motionloom.pipeline.inference.files.motion_data import MotionData

FAR_MM = 20.0
"""A figure that is further from the generated joints, on average, is worth a word."""


class FigureOptions(Config):
    """Ways in which the figure follows the generated joints."""

    plant_feet: bool = True
    """Hold feet still where they stand (`datasets/motion/body/feet.py`)."""
    body_model: Path | None = None
    """Your SMPL-X model (.npz), which the files of format smplx are made for."""
    more: dict[str, Any] = Field(default_factory=dict)
    """Options that formats of others take, by name (`Writer.options`)."""
    arkit_bases: Path | None = None
    """Your two bases (.npz with `source` and `arkit`), which expressions become ARKit weights by; without,
    expressions are those of the synthetic face."""


@dataclass(frozen=True)
class ShownMotion:
    """A generated motion and the figure that is shown of it."""

    motion: MotionData
    figure: RigidMotion
    feet: FeetReport | None = None

    @property
    def joints(self) -> NDArray[np.float64]:
        """Joints that page and npz show [T, N, 3], metres."""
        return self.figure.joints

    @property
    def fps(self) -> float:
        return self.motion.layout.fps

    @property
    def remark(self) -> str:
        """A note on the figure's distance from the generated joints where it is large; else empty."""
        error = self.figure.error
        return f"the figure is {error} from the generated joints" if error.mean_mm > FAR_MM else ""

    def facts(self) -> dict[str, object]:
        """Distance from the generated joints and sliding of the feet, for metadata."""
        error = self.figure.error
        out: dict[str, object] = {
            "fit_mean_mm": round(error.mean_mm, 3),
            "fit_max_mm": round(error.max_mm, 3),
            "feet_planted": self.feet is not None,
        }
        if self.feet is not None:
            out["fit_unplanted_mean_mm"] = round(self.feet.unplanted.mean_mm, 3)
            out["fit_unplanted_max_mm"] = round(self.feet.unplanted.max_mm, 3)
            out["slide_before_cm_s"] = round(self.feet.slide_before, 3)
            out["slide_after_cm_s"] = round(self.feet.slide_after, 3)
        return out


def shown(motion: MotionData | ShownMotion, options: FigureOptions | None = None) -> ShownMotion:
    """The figure of one motion; one that was made already stays what it is."""
    if isinstance(motion, ShownMotion):
        return motion
    if motion.figure is not None:
        return ShownMotion(motion, motion.figure)
    options = options or FigureOptions()
    layout = motion.layout
    figure = fit_rigid(motion.joints, layout.skeleton, rotations=rotations_of(motion.features, layout))
    if not options.plant_feet:
        return ShownMotion(motion, figure)
    # Only the h3d family has contact columns; others are judged by height and speed.
    columns = motion.features if layout.family == "h3d" else None
    contacts = foot_contacts(figure.joints, layout.skeleton, layout.fps, columns, layout)
    return ShownMotion(motion, *plant_feet(figure, motion.joints, contacts, layout.fps))
