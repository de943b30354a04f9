"""Animations of a character's file as clips: `hero.glb/02-walk.animation` is the third one of `hero.glb`.

The inverse of `rig.py`: world rotations of nodes become those of our joints, on the character's bones. Faces
are not read.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.rigid import RigidMotion
from motionloom.datasets.motion.bvh.motion import write_bvh
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.pipeline.inference.clip_file import LEAST_FRAMES, RecordedClip
from motionloom.pipeline.rigs.gltf import Gltf
from motionloom.pipeline.rigs.rig import Rig

Floats = NDArray[np.float64]
T = TypeVar("T")

SUFFIX = ".animation"
ENDINGS = (".glb", ".vrm", ".vrma")
_RATES = (10.0, 120.0)
_MOST_ANIMATIONS = 1000
_MOST_SECONDS, _MOST_POSES, _POSES_A_KEY = 3600.0, 300_000, 100
"""Length of a clip, and its frames times the file's nodes: 100 seconds of 150 nodes at 20 a second, and more
the more keys it has, so that two keys hours apart take no memory."""


def clips_in(path: Path) -> dict[str, str]:
    """Names of the clips of a file -> their captions, the animations' names."""
    try:
        animations = _animations(Gltf.read(path))
    except UserError:  # the conversion counts it, and says why
        return {f"{path.name}/00-{SUFFIX}": ""}
    out = {}
    for number, animation in enumerate(animations):
        plain = re.sub(r"[^0-9A-Za-z]+", "-", _name(animation))[:40].strip("-")
        out[f"{path.name}/{number:02d}-{plain}{SUFFIX}"] = _words(animation)
    return out


def _name(animation: dict[str, Any]) -> str:
    return str(animation.get("name") or "")[:200]


def _words(animation: dict[str, Any]) -> str:
    return re.sub(r"(?<=[a-z])(?=[A-Z])|[_|.]+", " ", _name(animation)).strip()


@lru_cache(maxsize=4)
def _rig(path: Path, changed: int, size: int) -> Rig | UserError:
    """The character of a file as it was then, or why it has none, which the clips of one file share: a file
    may have hundreds."""
    try:
        return Rig.read(path)
    except UserError as error:
        return error


def _animations(gltf: Gltf) -> list[dict[str, Any]]:
    """The animations of a file; `UserError` where they are none."""
    found = gltf.json.get("animations") or []
    if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
        raise UserError(f"{gltf.where}: its animations cannot be read")
    if len(found) > _MOST_ANIMATIONS:
        raise UserError(f"{gltf.where}: {len(found)} animations, at most {_MOST_ANIMATIONS} are read; cut it")
    return found


def read_animation(path: Path, label: str) -> bytes:
    """A clip's BVH text, on our joints, in centimetres."""
    try:
        about = path.parent.stat()
    except OSError as error:
        raise UserError(f"{label}: cannot be read ({error.strerror})") from None
    rig = _rig(path.parent, about.st_mtime_ns, about.st_size)
    if isinstance(rig, UserError):
        raise rig
    return _made(_text, rig, _number(path), label)


def _made(make: Callable[[Rig, int], T], rig: Rig, number: int, label: str) -> T:
    """Return what `make` returns for an animation; `UserError` names the clip."""
    animations = _animations(rig.gltf)
    if not 0 <= number < len(animations):
        raise UserError(f"{label}: {Path(rig.gltf.where).name} has {len(animations)} animations")
    try:
        return make(rig, animations.index(animations[number]))  # the first of its equals
    except (UserError, ArithmeticError, ValueError) as error:
        raise UserError(f"{label}: no motion can be read ({error})") from None


@lru_cache(maxsize=1)
def _text(rig: Rig, number: int) -> bytes:
    """The BVH text of an animation, of which a file may have a thousand copies."""
    rotations, root, fps = _posed(rig, number)
    with tempfile.TemporaryDirectory() as folder:
        write_bvh(Path(folder) / "clip.bvh", rig.skeleton, rotations, root, fps)
        return (Path(folder) / "clip.bvh").read_bytes()


def read_character(path: Path) -> RecordedClip:
    """The first animation of a character's file that is long enough for a clip; or the one that a name as of
    `clips_in` says.
    """
    named = path.suffix.lower() == SUFFIX
    file = path.parent if named else path
    rig = Rig.read(file)
    animations = _animations(rig.gltf)
    if not animations:
        raise UserError(f"{path}: a character without an animation; give a file that has one")
    numbers = [_number(path)] if named else range(len(animations))
    for number in numbers:
        try:
            rotations, root, fps = _made(_posed, rig, number, str(path))
        except UserError:
            if number == numbers[-1]:
                raise
            continue
        if len(root) >= LEAST_FRAMES:
            break
    own = rig.skeleton
    joints, _ = forward_kinematics(rotations, root, own.offsets, own.parents)
    figure = RigidMotion.posed(own, rotations, root, joints)
    return RecordedClip(str(path), joints, fps, None, _words(animations[number]), figure=figure)


def _number(path: Path) -> int:
    """Which animation a clip's name says; -1 for none."""
    found = re.match(r"\d+", path.name)
    return int(found[0]) if found else -1


def _posed(rig: Rig, number: int) -> tuple[Floats, Floats, float]:
    """Local rotations [T, J, 3, 3], root [T, 3] and frame rate of an animation on our joints."""
    turns, places, fps = _played(rig, _animations(rig.gltf)[number])
    return (*_ours(rig, turns, places), fps)


def _ours(rig: Rig, turns: Floats, places: Floats) -> tuple[Floats, Floats]:
    """Local rotations [T, J, 3, 3] and root [T, 3] of world rotations [T, N, 3, 3] and places of the hips."""
    parents = rig.skeleton.parents
    names = rig.skeleton.joints
    world = np.empty((len(turns), len(names), 3, 3))
    for joint, name in enumerate(names):
        if (node := rig.nodes.get(name)) is None:
            world[:, joint] = world[:, parents[joint]]
        else:
            change = rig.ahead @ turns[:, node] @ rig.turns[node].T @ rig.ahead.T
            world[:, joint] = change @ rig.laid[joint]
    local = world.copy()
    local[:, 1:] = world[:, list(parents[1:])].swapaxes(-1, -2) @ world[:, 1:]
    return local, places @ rig.ahead.T / rig.unit


def _played(rig: Rig, animation: dict[str, Any]) -> tuple[Floats, Floats, float]:
    """World rotations of all nodes [T, N, 3, 3], places of the hips [T, 3], and the frame rate."""
    gltf = rig.gltf
    try:
        tracks = [
            (int(one["target"]["node"]), str(one["target"]["path"]), animation["samplers"][one["sampler"]])
            for one in animation["channels"]
            if one["target"].get("path") in ("rotation", "translation") and "node" in one["target"]
        ]
        read = {
            (node, path): (
                gltf.values(int(sampler["input"]))[:, 0],
                gltf.values(int(sampler["output"])),
                sampler,
            )
            for node, path, sampler in tracks
        }
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise UserError(f"an animation that cannot be read ({type(error).__name__})") from None
    longest = max((times for times, _, _ in read.values()), key=len, default=np.zeros(1))
    if len(longest) < 2 or not np.ptp(longest) > 0:
        raise UserError("an animation in which nothing moves")
    fps = float(np.clip(round(1 / float(np.median(np.diff(longest)).clip(1e-4))), *_RATES))
    seconds = min(float(max(times.max() for times, _, _ in read.values())), _MOST_SECONDS)
    at = np.arange(int(seconds * fps + 1e-6) + 1) / fps
    most = _MOST_POSES + _POSES_A_KEY * sum(len(times) for times, _, _ in read.values())
    if len(at) * len(gltf.parents) > most:
        raise UserError(f"{len(at)} frames of {len(gltf.parents)} nodes are too many; cut it")
    turned = np.empty((len(gltf.parents), len(at), 3, 3))
    worlds = np.empty((len(gltf.parents), len(at), 4, 4))
    for node in gltf.in_order():
        place, turn, scale = gltf.local(node)
        matrix = np.tile(np.eye(4), (len(at), 1, 1))
        local = np.broadcast_to(turn, (len(at), 3, 3))
        if (node, "rotation") in read:
            local = Rotation.from_quat(_sampled(*read[node, "rotation"], at, 4)).as_matrix()
        matrix[:, :3, :3] = local * scale
        matrix[:, :3, 3] = (
            _sampled(*read[node, "translation"], at, 3) if (node, "translation") in read else place
        )
        parent = gltf.parents[node]
        turned[node] = turned[parent] @ local if parent >= 0 else local
        worlds[node] = worlds[parent] @ matrix if parent >= 0 else matrix
    return turned.swapaxes(0, 1), worlds[rig.nodes["pelvis"], :, :3, 3], fps


def _sampled(times: Floats, keys: Floats, sampler: dict[str, Any], at: Floats, width: int) -> Floats:
    """Keys at times [T]: [T, W]; quaternions on the straight way, which is near for keys of a recording."""
    if sampler.get("interpolation") == "CUBICSPLINE":
        keys = keys[1::3]  # between its two tangents
    times, keys = times[: len(keys)], keys[: len(times)]
    if keys.shape[1] != width or not len(keys) or (np.diff(times) < 0).any():
        raise UserError("an animation whose keys do not fit its times")
    if width == 4:
        signs = np.where(np.einsum("tq,tq->t", keys[1:], keys[:-1]) < 0, -1.0, 1.0)
        keys = keys * np.concatenate([[1.0], np.cumprod(signs)])[:, None]
    if sampler.get("interpolation") == "STEP":
        return np.asarray(keys[np.searchsorted(times, at, side="right").clip(1) - 1])
    return np.stack([np.interp(at, times, column) for column in keys.T], axis=-1)
