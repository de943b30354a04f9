"""Whether the clips of a data set show people standing on a floor.

The measure is the one that a conversion looks at its source with (`datasets/motion/standing.py`), here of
every clip. An error when it is so in more than half of the clips, a warning when in more than a fifth: sets
hold people who lie, climb and crawl, too. Of single folders of the source, for a set put together of several:
a warning.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.check.findings import Findings
from motionloom.datasets.motion.joints import joints_of
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout
from motionloom.datasets.motion.standing import Crowd, measure
from motionloom.datasets.motion.swapped_joints import find_swap
from motionloom.datasets.schema import ClipMeta

_MOST_FOLDERS = 64
"""Folders of the source that are judged by themselves."""
_LEAST_CLIPS = 10
"""Clips in such a folder."""
_BODIES = 40
"""Clips, spread over the set, that are searched for two joints in each other's place."""
_BODY_FRAMES = 10


class Figures:
    """Collects the clips of a set. `clips` is how many there will be."""

    def __init__(self, layout: MotionLayout, clips: int) -> None:
        self._layout = layout
        self._every = max(1, -(-clips // _BODIES))
        self._all, self._folders = Crowd(), dict[str, Crowd]()
        self._bodies: list[NDArray[np.float64]] = []
        # Retargeted or posed figures have the bones of the layout's skeleton: nothing is left to see in them.
        self._has_own_bones = layout.family == "exact"
        # Parameters may stay on the floor of their source.
        self._on_zero = layout.family != "raw"

    def add(self, meta: ClipMeta, motion: NDArray[np.floating]) -> None:
        """Measure one clip [T, D]."""
        joints = joints_of(motion, self._layout)
        clip = measure(joints, self._layout.fps)
        if self._has_own_bones and len(self._all) % self._every == 0:
            frames = np.linspace(0, len(joints) - 1, min(_BODY_FRAMES, len(joints))).astype(int)
            self._bodies.append(joints[frames, :BODY_JOINTS])
        self._all.add(clip)
        folder = meta.source.split("/", 1)[0] if "/" in meta.source else ""
        if folder in self._folders or len(self._folders) < _MOST_FOLDERS:
            self._folders.setdefault(folder, Crowd()).add(clip)

    def report(self, root: Path, findings: Findings) -> None:
        """What all clips together are not."""
        oddities = self._all.oddities(floor_at_zero=self._on_zero)
        for oddity in oddities:
            if oddity.is_error:
                findings.error("no people standing on a floor", str(root), oddity.text)
            else:
                findings.warn("odd figures", str(root), oddity.text)
        known = {oddity.kind for oddity in oddities}
        for folder, crowd in sorted(self._folders.items()):
            if len(self._folders) == 1 or len(crowd) < _LEAST_CLIPS:
                continue
            for oddity in crowd.oddities(floor_at_zero=self._on_zero):
                if oddity.is_error and oddity.kind not in known:
                    findings.warn("odd figures", str(root), f"source '{folder or '.'}': {oddity.text}")
        swap = find_swap(self._bodies)
        if swap is not None:
            first, second = swap.names
            findings.error(
                "no people standing on a floor",
                str(root),
                f"{first} and {second} stand in each other's place: two rows of the joint map are swapped",
            )
