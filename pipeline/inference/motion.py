"""`GeneratedMotion`: one motion that writes its files and shows itself."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from motionloom.pipeline.inference.files.motion_data import MotionData


@dataclass(frozen=True, repr=False)
class GeneratedMotion(MotionData):
    """One generated clip. In a notebook it shows itself."""

    def save(self, path: Path | str) -> Path:
        """Write one file, of the format that its ending names (`writers.WRITERS`); returns its path."""
        from motionloom.pipeline.inference.files.outputs import save

        path = Path(path)
        save(path, self)
        return path

    def _repr_html_(self) -> str:
        """The viewer, in a frame of its own that can reach neither the notebook nor the network."""
        from motionloom.pipeline.inference.files.outputs import frame_of

        return frame_of(self)
