"""The files that a motion can be written as."""

from __future__ import annotations

from typing import Literal

Format = Literal["npz", "bvh", "mp4", "html", "glb", "smplx", "arkit"]
FORMATS: tuple[Format, ...] = ("npz", "bvh", "mp4", "html")
"""What is written unless asked otherwise; the others are written where they are named."""
