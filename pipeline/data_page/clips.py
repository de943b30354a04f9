"""Clips of a data set to watch: a few that differ as much as possible, as joints small enough for a page.

Raw layouts (SMPL parameters) are posed on the neutral skeleton: the pose is the data's, the bones are not.
"""

from __future__ import annotations

import numpy as np

from motionloom.datasets.motion.canonical import canonicalize, resample
from motionloom.datasets.motion.features import face_of
from motionloom.datasets.motion.joints import joints_of
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.pipeline.data_page.facts import DataFacts
from motionloom.pipeline.render.face import synthetic_face_controls
from motionloom.pipeline.render.viewer import ViewerMotion

WATCH_FPS, WATCH_SECONDS = 20.0, 10.0
"""Clips are thinned and cut to this for the page."""


def choose(facts: DataFacts, opened: dict[str, ShardDataset], count: int) -> list[tuple[str, int]]:
    """At most `count` (split, clip number): the most ordinary first, then each as unlike the rest as can be.

    The same data give the same choice. A caption is not shown twice while there are others.
    """
    values = facts.described.astype(np.float64)
    middle = np.median(values, axis=0)
    spread = np.percentile(values, 95, axis=0) - np.percentile(values, 5, axis=0)
    # Cut at both ends: otherwise only glitches and the longest clips would be chosen.
    values = np.clip((values - middle) / np.where(spread > 1e-9, spread, np.inf), -1, 1)
    distance = np.linalg.norm(values, axis=1)
    order, seen, spare = int(np.argmin(distance)), set(), []
    chosen: list[int] = []
    apart = np.full(len(values), np.inf)
    while len(chosen) < count and np.isfinite(order):
        split, clip = facts.candidates[order]
        texts = opened[split].texts(clip)
        words = texts[0].text if texts else None
        apart[order] = -1.0
        if words is not None and words in seen:
            spare.append(order)
        else:
            seen.add(words or "")
            chosen.append(order)
            nearer = np.linalg.norm(values - values[order], axis=1)
            apart = np.where(apart < 0, apart, np.minimum(apart, nearer))
        order = int(np.argmax(apart))
        if apart[order] < 0:
            break
    chosen += spare[: count - len(chosen)]
    return [facts.candidates[k] for k in chosen]


def watch(dataset: ShardDataset, clip: int) -> ViewerMotion:
    """One clip for the viewer."""
    layout = dataset.layout
    motion = dataset.motion(clip)[: int(WATCH_SECONDS * layout.fps)]
    joints = joints_of(motion, layout)
    if layout.family == "raw":
        joints = canonicalize(joints)  # sources have their own axes
    face = None
    if dataset.manifest.converter == "synth" and layout.has("face"):
        face = synthetic_face_controls(face_of(motion, layout))
    fps = layout.fps
    if fps > WATCH_FPS:
        joints = resample(joints, fps, WATCH_FPS)
        face = None if face is None else resample(face, fps, WATCH_FPS)
        fps = WATCH_FPS
    texts = dataset.texts(clip)
    whole = [caption for caption in texts if caption.end is None] or texts
    caption = whole[0].text if whole else "no caption"
    return ViewerMotion(
        joints, fps, layout.skeleton.parents, f"{dataset.split} · {dataset.ids[clip]}", caption, "", face
    )
