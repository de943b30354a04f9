"""The figure that all outputs show of a generated motion: one rigid skeleton, feet planted where asked for.

Page, film, pictures, BVH, GLB and npz take it from here, so they show the same. Evaluation and metrics never
do: they read the features' own joints (`GeneratedMotion.joints`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from motionloom.datasets.motion.body.feet import FeetOptions, FeetReport, foot_contacts, plant_feet
from motionloom.datasets.motion.body.rigid import RigidMotion, fit_rigid
from motionloom.datasets.motion.features.joints import rotations_of
from motionloom.datasets.schema import Config
from motionloom.pipeline.inference.motion import GeneratedMotion


class FigureOptions(Config):
    """How the figure follows the generated joints."""

    rigid: bool = True
    """Show bones of constant length; without, page, film and npz show the generated joints as they are. BVH,
    GLB and SMPL-X files have bones in any case."""
    symmetric: bool = False
    """Left and right bones of one length."""
    plant_feet: bool = False
    """Hold feet still where they stand (`datasets/motion/body/feet.py`)."""
    feet: FeetOptions = FeetOptions()
    body_model: Path | None = None
    """Your SMPL-X model (.npz), which the files of format smplx are made for."""
    arkit_bases: Path | None = None
    """Your two bases (.npz with `source` and `arkit`), which expressions become ARKit weights by; without,
    expressions are those of the synthetic face."""

    @model_validator(mode="after")
    def _feet_on_bones(self) -> FigureOptions:
        if self.plant_feet and not self.rigid:
            raise ValueError("plant_feet moves the rigid figure: leave rigid on (--rigid)")
        return self


@dataclass(frozen=True)
class ShownMotion:
    """A generated motion and the figure that is shown of it."""

    motion: GeneratedMotion
    figure: RigidMotion
    joints: NDArray[np.float64]
    """What page, film and npz show [T, N, 3], metres: the figure's joints, or the generated ones."""
    feet: FeetReport | None = None

    @property
    def rigid(self) -> RigidMotion | None:
        """The figure, where it is what page, film and npz show."""
        return self.figure if self.joints is self.figure.joints else None

    @property
    def fps(self) -> float:
        return self.motion.layout.fps

    @property
    def sentence(self) -> str:
        """How far the figure is from the generated joints, in one line."""
        feet = "" if self.feet is None else f"; {self.feet}"
        return f"bones of constant length, {self.figure.error} from the generated joints{feet}"

    def facts(self) -> dict[str, object]:
        """The same as numbers, for metadata."""
        error = self.figure.error
        out: dict[str, object] = {
            "rigid": self.rigid is not None,
            "fit_mean_mm": round(error.mean_mm, 3),
            "fit_max_mm": round(error.max_mm, 3),
        }
        if self.feet is not None:
            out["fit_unplanted_mean_mm"] = round(self.feet.unplanted.mean_mm, 3)
            out["fit_unplanted_max_mm"] = round(self.feet.unplanted.max_mm, 3)
            out["slide_before_cm_s"] = round(self.feet.slide_before, 3)
            out["slide_after_cm_s"] = round(self.feet.slide_after, 3)
        return out


def shown(motion: GeneratedMotion | ShownMotion, options: FigureOptions | None = None) -> ShownMotion:
    """The figure of one motion; one that was made already stays what it is."""
    if isinstance(motion, ShownMotion):
        return motion
    options = options or FigureOptions()
    layout = motion.layout
    figure = fit_rigid(
        motion.joints,
        layout.skeleton,
        rotations=rotations_of(motion.features, layout),
        symmetric=options.symmetric,
    )
    feet = None
    if options.plant_feet:
        # Only the h3d family has contact columns; others are judged by height and speed.
        columns = motion.features if layout.family == "h3d" else None
        contacts = foot_contacts(figure.joints, layout.skeleton, layout.fps, options.feet, columns, layout)
        figure, feet = plant_feet(figure, motion.joints, contacts, layout.fps, options.feet)
    return ShownMotion(motion, figure, figure.joints if options.rigid else motion.joints, feet)
