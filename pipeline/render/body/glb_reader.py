"""Joints of a GLB file that was written here: the skeleton's nodes and their animation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError

_LARGEST = 2**28
_FLOAT = 5126
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def read_glb(path: Path) -> tuple[NDArray[np.float64], float, str]:
    """Joints [T, N, 3] in metres, frames a second and the name of a file's first animation.

    `UserError` for a file of other figures than those of `write_glb`, and for a damaged one.
    """
    if path.stat().st_size > _LARGEST:
        raise UserError(f"{path}: {path.stat().st_size:,} bytes; at most {_LARGEST:,} are read")
    try:
        from pygltflib import GLTF2
    except ModuleNotFoundError:
        raise UserError(f"{path}: GLB files need pygltflib; pip install 'motionloom[glb]'") from None
    from scipy.spatial.transform import Rotation

    try:
        gltf = GLTF2().load_binary(str(path))
        blob = gltf.binary_blob() or b""
        nodes = [gltf.nodes[node] for node in gltf.skins[0].joints]
        animation = gltf.animations[0]
        fps = float(animation.extras["fps"])

        def values(number: int) -> NDArray[np.float64]:
            accessor = gltf.accessors[number]
            if accessor.componentType != _FLOAT:
                raise ValueError("an animation of whole numbers")
            view = gltf.bufferViews[accessor.bufferView]
            start, width = (view.byteOffset or 0) + (accessor.byteOffset or 0), _WIDTHS[accessor.type]
            flat = np.frombuffer(blob, "<f4", accessor.count * width, start)
            return flat.reshape(-1, width).astype(np.float64)

        tracks = {
            (channel.target.node, channel.target.path): values(animation.samplers[channel.sampler].output)
            for channel in animation.channels
            if channel.target.path != "weights"
        }
        names = tuple(node.name for node in nodes)
        skeleton = next(one for one in map(Skeleton.named, ("smplx52", "smpl22")) if one.joints == names)
        offsets = np.array([node.translation for node in nodes], dtype=np.float64)
        frames = max(len(track) for track in tracks.values())
        turns = np.empty((frames, len(names), 4))
        for joint in range(len(names)):
            turns[:, joint] = tracks[joint, "rotation"]
        rotations = Rotation.from_quat(turns.reshape(-1, 4)).as_matrix().reshape(frames, len(names), 3, 3)
        root = np.broadcast_to(tracks[0, "translation"], (frames, 3))
    except Exception as error:  # a file from anywhere breaks this in many ways
        if isinstance(error, MemoryError):
            raise
        raise UserError(
            f"{path}: not a GLB file that motionloom wrote ({type(error).__name__}); give its BVH or npz"
        ) from None
    joints, _ = forward_kinematics(rotations, root, offsets, skeleton.parents)
    return joints, fps, str(animation.name or "")
