"""Motion files of the `bvh` source: BVH, and AMC behind its ASF (`common/scan.py` joins the two)."""

from __future__ import annotations

from contextlib import suppress

from motionloom.datasets.motion.bvh.asf import FPS, JOINED, count_frames, read_amc, skeleton_of
from motionloom.datasets.motion.bvh.joint_map import skeleton_key
from motionloom.datasets.motion.bvh.motion import BvhMotion, read_bvh
from motionloom.datasets.motion.bvh.text import find_motion, load_text, parse_hierarchy, require_all_frames
from motionloom.datasets.schema import UserError


def read_motion(data: bytes, label: str) -> BvhMotion:
    """The motion of a BVH file, or of an AMC file behind its skeleton."""
    asf, joined, amc = data.partition(JOINED)
    return read_amc(asf, amc, name=label) if joined else read_bvh(data, name=label)


def read_header(data: bytes, label: str) -> tuple[int, float, str, tuple[str, ...]]:
    """Frames, frame rate, skeleton and its joints; `UserError` when the file cannot be read."""
    asf, joined, amc = data.partition(JOINED)
    if joined:
        found, parents = skeleton_of(asf, label)
        return count_frames(amc, label), FPS, skeleton_key(found, parents), found
    text, where = load_text(data, label)
    section = find_motion(text, where)
    require_all_frames(text, section, where)
    key, names = "", tuple[str, ...]()
    with suppress(UserError):  # a broken hierarchy is reported when the clip is converted
        joints = parse_hierarchy(text[: section.start], where)
        key, names = skeleton_key(joints.names, joints.parents), tuple(joints.names)
    return section.frames, section.fps, key, names
