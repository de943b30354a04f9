"""GLB (binary glTF 2.0): the skinned body, its skeleton, and motions as animations of one file.

Metres, Y up, +Z ahead, as glTF wants it; key times are seconds, so a frame rate is kept without being named.
Two meshes share the skin: the body, and the head, whose expressions are morph targets. The rest pose is the
T-pose, standing on the floor, and every joint's rest rotation is none: an animation's rotations are the
figure's local rotations.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import atomic_file
from motionloom.datasets.base.json_doors import number, parse_json, read_plain
from motionloom.datasets.motion.body.retarget import on_one_skeleton
from motionloom.datasets.motion.body.rigid import RigidMotion, with_offsets
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body.face import ARKIT, EXPRESSIONS
from motionloom.pipeline.render.body.mesh import FIRST_OF_HEAD, Body, body_for, colours

_FLOAT = 5126
_SHORT = 5123
_BYTE = 5121
_VERTICES = 34962
_INDICES = 34963
_NEAREST = 9728
_CLAMP = 33071
_STRIP = 16
"""Columns of the colours' picture: one a swatch."""
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_LARGEST = 2**28
_LARGEST_JSON = 2**17
"""Bytes of the JSON in a file that is read: ours has 30 kB, and pygltflib takes 2 s a megabyte."""
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


Faces = Literal["expressions", "arkit"]
"""Morph targets of the head: those of the synthetic basis, or ARKit's 52."""
Values = NDArray[np.generic]


@dataclass(frozen=True)
class GlbClip:
    """One animation: a rigid motion of T frames."""

    name: str
    figure: RigidMotion
    fps: float
    expression: NDArray[np.floating] | None = None
    """Weights [T, E] of the face's shapes: `face.expression_weights` [T, 8], or ARKit's [T, 52]."""
    facts: dict[str, object] = field(default_factory=dict)
    """Goes into the animation's `extras`, plain JSON."""


def write_glb(path: Path, clips: Sequence[GlbClip], faces: Faces = "expressions") -> list[RigidMotion]:
    """Write the clips as animations of one body; returns the figures as written.

    `faces` chooses the head's morph targets, which the clips' expressions are weights of. Clips of different
    bone lengths are posed on their mean skeleton. The file appears whole or not at all.
    """
    names = ARKIT if faces == "arkit" else EXPRESSIONS
    for clip in clips:
        if not np.isfinite(clip.figure.rotations).all() or not np.isfinite(clip.figure.root).all():
            raise UserError(f"{path}: '{clip.name}' holds NaN or infinite values; a GLB file cannot")
    figures = on_one_skeleton([clip.figure for clip in clips])
    body = body_for(figures[0].skeleton, names)
    try:
        data = b"".join(_Scene(body, clips, figures).gltf.save_to_bytes())
    except ModuleNotFoundError as error:
        if error.name != "pygltflib":
            raise
        raise UserError(f"{path}: GLB files need pygltflib; pip install 'motionloom[glb]'") from None
    with atomic_file(path) as file:
        file.write(data)
    return figures


class _Scene:
    """The file while it is put together."""

    def __init__(self, body: Body, clips: Sequence[GlbClip], figures: Sequence[RigidMotion]) -> None:
        from pygltflib import GLTF2, Asset, Buffer, Node, Scene, Skin

        self.gltf = GLTF2(asset=Asset(version="2.0", generator="motionloom"), scene=0)
        self.blob = bytearray()
        skeleton = body.skeleton
        count = len(body.skeleton)
        self.lift = np.array([0.0, -float(body.vertices[:, 1].min()), 0.0])
        """From the body, whose pelvis is the origin, to one that stands on the floor at rest."""
        # Joints are nodes 0..N-1, in the skeleton's order.
        for joint, name in enumerate(skeleton.joints):
            children = [child for child, parent in enumerate(skeleton.parents) if parent == joint]
            lift = self.lift if joint == 0 else np.zeros(3)
            place = [float(value) for value in skeleton.offsets[joint] + lift]
            self.gltf.nodes.append(Node(name=name, translation=place, children=children))
        bind = np.tile(np.eye(4), (count, 1, 1))
        # Column-major: the last row here is the last column there.
        bind[:, 3, :3] = -(skeleton.rest_joints + self.lift)
        self.gltf.skins = [
            Skin(
                name="skeleton",
                joints=list(range(count)),
                inverseBindMatrices=self._add(bind.reshape(-1, 16)),
            )
        ]
        self._material()
        # Two meshes, since morph targets hold a displacement for every vertex of theirs.
        head = body.swatch >= FIRST_OF_HEAD
        self._mesh("body", body, ~head, expressions=False)
        self._mesh("head", body, head, expressions=True)
        self.gltf.nodes += [Node(name="body", mesh=0, skin=0), Node(name="head_mesh", mesh=1, skin=0)]
        self.gltf.nodes.append(Node(name="figure", children=[0]))
        self.gltf.scenes = [Scene(name="scene", nodes=[count + 2, count, count + 1])]
        names = Counter[str]()
        for clip, figure in zip(clips, figures, strict=True):
            name = clip.name or "motion"
            names[name] += 1  # tools tell animations apart by name, so a repeated one gets a number
            name = name if names[name] == 1 else f"{name} ({names[name]})"
            self._animation(name, clip, figure, head=count + 1)
        self.gltf.buffers = [Buffer(byteLength=len(self.blob))]
        self.gltf.set_binary_blob(bytes(self.blob))

    def _material(self) -> None:
        from PIL import Image as Picture
        from pygltflib import Image, Material, PbrMetallicRoughness, Sampler, Texture, TextureInfo

        stream = io.BytesIO()
        swatches = np.zeros((_STRIP, _STRIP, 3), np.uint8)  # square and a power of two, for old players
        swatches[:, : len(colours())] = colours()
        Picture.fromarray(swatches).save(stream, "PNG")
        view = self._view(stream.getvalue(), None)
        self.gltf.images = [Image(name="colours", mimeType="image/png", bufferView=view)]
        sampler = Sampler(magFilter=_NEAREST, minFilter=_NEAREST, wrapS=_CLAMP, wrapT=_CLAMP)
        self.gltf.samplers = [sampler]
        self.gltf.textures = [Texture(source=0, sampler=0)]
        colour = PbrMetallicRoughness(
            baseColorTexture=TextureInfo(index=0), metallicFactor=0.0, roughnessFactor=0.7
        )
        self.gltf.materials = [Material(name="figure", pbrMetallicRoughness=colour)]

    def _mesh(self, name: str, body: Body, chosen: NDArray[np.bool_], *, expressions: bool) -> None:
        from pygltflib import Accessor, Attributes, Mesh, Primitive

        number = np.cumsum(chosen) - 1
        triangles = number[body.triangles[chosen[body.triangles[:, 0]]]]
        joints, shares = _merged(body.joints[chosen], body.shares[chosen])
        uv = np.column_stack([(body.swatch[chosen] + 0.5) / _STRIP, np.full(int(chosen.sum()), 0.5)])
        attributes = Attributes(
            POSITION=self._add(body.vertices[chosen] + self.lift, target=_VERTICES, bounds=True),
            NORMAL=self._add(_unit(body.normals[chosen]), target=_VERTICES),
            TEXCOORD_0=self._add(uv, target=_VERTICES),
            JOINTS_0=self._add(joints, _BYTE, _VERTICES),
            WEIGHTS_0=self._add(shares, target=_VERTICES),
        )
        indices = self._add(triangles.reshape(-1, 1), _SHORT, _INDICES)
        primitive = Primitive(attributes=attributes, indices=indices, material=0)
        mesh = Mesh(name=name, primitives=[primitive])
        if expressions:
            moves = body.shapes
            at_rest = [not move.any() for move in moves.values()]
            still = len(self.gltf.accessors)
            zero = [0.0, 0.0, 0.0]
            if any(at_rest):  # shapes that move nothing share one accessor of zeros, which takes no room
                count = int(chosen.sum())
                self.gltf.accessors.append(
                    Accessor(
                        byteOffset=None, componentType=_FLOAT, count=count, type="VEC3", min=zero, max=zero
                    )
                )
            primitive.targets = [
                {"POSITION": still if rest else self._add(move[chosen], target=_VERTICES, bounds=True)}
                for rest, move in zip(at_rest, moves.values(), strict=True)
            ]
            mesh.weights = [0.0] * len(moves)
            # Blender, three.js and engines read the targets' names from here.
            mesh.extras = {"targetNames": list(moves)}
        self.gltf.meshes.append(mesh)

    def _animation(self, name: str, clip: GlbClip, figure: RigidMotion, head: int) -> None:
        from pygltflib import Animation, AnimationChannel, AnimationChannelTarget, AnimationSampler
        from scipy.spatial.transform import Rotation

        frames, count = figure.rotations.shape[:2]
        animation = Animation(name=name, extras={"fps": clip.fps, **clip.facts})
        every = self._add((np.arange(frames) / clip.fps)[:, None], bounds=True)
        first: list[int] = []

        def channel(node: int, path: str, values: Values) -> None:
            # One key is enough for what does not move, such as the fingers of a body without hands.
            still = len(values) == frames and not (values != values[:1]).any()
            kept = values[:1] if still else values
            if path == "weights":
                kept = kept.reshape(-1, 1)
            if still and not first:
                first.append(self._add(np.zeros((1, 1)), bounds=True))
            sampler = AnimationSampler(
                input=first[0] if still else every, output=self._add(kept), interpolation="LINEAR"
            )
            target = AnimationChannelTarget(node=node, path=path)
            animation.channels.append(AnimationChannel(sampler=len(animation.samplers), target=target))
            animation.samplers.append(sampler)

        channel(0, "translation", figure.root.astype(np.float32))
        turns = Rotation.from_matrix(figure.rotations.reshape(-1, 3, 3)).as_quat().reshape(frames, count, 4)
        # q and -q are one rotation; between keys players take the straight way, so neighbours share a sign.
        flips = np.sign(np.einsum("tnq,tnq->tn", turns[1:], turns[:-1]))
        turns[1:] *= np.cumprod(np.where(flips < 0, -1.0, 1.0), axis=0)[..., None]
        for joint in range(count):
            channel(joint, "rotation", _unit(turns[:, joint]))
        if clip.expression is not None:
            channel(head, "weights", np.asarray(clip.expression, dtype=np.float32))
        self.gltf.animations.append(animation)

    def _add(
        self, values: Values, kind: int = _FLOAT, target: int | None = None, bounds: bool = False
    ) -> int:
        """Number of a new accessor of values [count, width]."""
        from pygltflib import Accessor

        dtype = {_FLOAT: "<f4", _SHORT: "<u2", _BYTE: "u1"}[kind]
        data = np.ascontiguousarray(values, dtype=dtype)
        view = self._view(data.tobytes(), target)
        accessor = Accessor(bufferView=view, componentType=kind, count=len(data), type=_TYPES[data.shape[1]])
        if bounds:
            accessor.min = [float(value) for value in data.min(axis=0)]
            accessor.max = [float(value) for value in data.max(axis=0)]
        self.gltf.accessors.append(accessor)
        return len(self.gltf.accessors) - 1

    def _view(self, data: bytes, target: int | None) -> int:
        from pygltflib import BufferView

        view = BufferView(buffer=0, byteOffset=len(self.blob), byteLength=len(data), target=target)
        self.gltf.bufferViews.append(view)
        self.blob += data + bytes(-len(data) % 4)
        return len(self.gltf.bufferViews) - 1


def _merged(joints: NDArray[np.int64], shares: Values) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Joints and shares [V, 4] where no joint is named twice, as stiff hands have it; shares sum to 1."""
    joints = joints.copy()
    shares = shares.astype(np.float32)
    for k in range(1, 4):
        for first in range(k):
            same = joints[:, k] == joints[:, first]
            shares[same, first] += shares[same, k]
            shares[same, k] = 0
    joints[shares == 0] = 0
    return joints, shares / shares.sum(axis=1, keepdims=True)


def _unit(vectors: Values) -> NDArray[np.float32]:
    """Unit vectors [..., C] to float32's last digit, as validators ask."""
    rounded = np.asarray(vectors, dtype=np.float64)
    out: NDArray[np.float32] = (rounded / np.linalg.norm(rounded, axis=-1, keepdims=True)).astype(np.float32)
    return out


def read_glb(path: Path) -> tuple[RigidMotion, float, str]:
    """Figure, frame rate and name of the first animation; `UserError` for files not of `write_glb`."""
    raw = read_plain(path, _LARGEST)
    end = 20 + int.from_bytes(raw[12:16], "little")
    if end > _LARGEST_JSON:
        raise UserError(f"{path}: not a GLB file that motionloom wrote; give its BVH or npz")
    about = raw[20:end]
    parse_json(about, str(path))
    try:
        from pygltflib import GLTF2
    except ModuleNotFoundError:
        raise UserError(f"{path}: GLB files need pygltflib; pip install 'motionloom[glb]'") from None
    from scipy.spatial.transform import Rotation

    try:
        gltf = GLTF2.from_json(about)
        blob = raw[end + 8 :]
        nodes = [gltf.nodes[node] for node in gltf.skins[0].joints]
        animation = gltf.animations[0]
        fps = number(animation.extras["fps"], f"{path}: fps", 1000, 0.1)

        def values(place: int) -> NDArray[np.float64]:
            accessor = gltf.accessors[place]
            if accessor.componentType != _FLOAT:
                raise ValueError("an animation of whole numbers")
            view = gltf.bufferViews[accessor.bufferView]
            start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
            width = _WIDTHS[accessor.type]
            flat = np.frombuffer(blob, "<f4", accessor.count * width, start)
            if not np.isfinite(flat).all():
                raise ValueError("numbers that are not finite")
            return flat.reshape(-1, width).astype(np.float64)

        for sampler in animation.samplers:
            times = values(sampler.input)[:, 0]
            if sampler.interpolation != "LINEAR" or np.abs(times - np.arange(len(times)) / fps).max() > 1e-3:
                raise ValueError("its frames are not those of its rate")
        for node in gltf.nodes:
            if node.matrix or (node.scale or [1, 1, 1]) != [1, 1, 1]:
                raise ValueError("it is scaled or turned as a whole")
            if node not in nodes and (node.rotation or node.translation):
                raise ValueError("it is moved as a whole")
        tracks = {
            (channel.target.node, channel.target.path): values(animation.samplers[channel.sampler].output)
            for channel in animation.channels
            if channel.target.path != "weights"
        }
        names = tuple(node.name for node in nodes)
        skeleton = next(one for one in map(Skeleton.named, ("smplx52", "smpl22")) if one.joints == names)
        offsets = np.array([[0, 0, 0], *(node.translation for node in nodes[1:])], dtype=np.float64)
        frames = max(len(track) for track in tracks.values())
        turns = np.empty((frames, len(names), 4))
        for joint in range(len(names)):
            turns[:, joint] = tracks[joint, "rotation"]
        rotations = Rotation.from_quat(turns.reshape(-1, 4)).as_matrix().reshape(frames, len(names), 3, 3)
        root = np.broadcast_to(tracks[0, "translation"], (frames, 3))
    except Exception as error:  # a file from anywhere breaks this in many ways
        if isinstance(error, (MemoryError, UserError)):
            raise
        reason = error if type(error) is ValueError else type(error).__name__
        raise UserError(
            f"{path}: not a GLB file that motionloom wrote ({reason}); give its BVH or npz"
        ) from None
    joints, _ = forward_kinematics(rotations, root, offsets, skeleton.parents)
    figure = RigidMotion.posed(with_offsets(skeleton, offsets), rotations, root, joints)
    return figure, fps, str(animation.name or "")
