"""Who is drawn in film and pictures: the skinned body, or plain limbs for skeletons that have none.

An actor knows its triangles and colours, and where its vertices are in each frame. `draw_actor` paints one
frame onto an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.motion.rigid import RigidMotion
from motionloom.pipeline.render.body.face import control_weights
from motionloom.pipeline.render.body.mesh import Body, body_for, colour_strip
from motionloom.pipeline.render.body.posing import Posing, human_skeleton, posing_of
from motionloom.pipeline.render.camera import NEAR, Camera
from motionloom.pipeline.render.figure import CENTRE, LEFT, RIGHT, Figure, figure_for
from motionloom.pipeline.render.lighting import cast_shadow, lit
from motionloom.pipeline.render.raster import SOLE, cover

Floats = NDArray[np.float64]

_COLUMNS = {RIGHT: 1 / 6, CENTRE: 0.5, LEFT: 5 / 6}
_PAINTED_ROW = 2
_AROUND, _CAP = 10, 3
"""Corners around a plain limb, and rings of each of its round ends."""


class Actor(Protocol):
    """A mesh of V vertices that moves."""

    @property
    def triangles(self) -> NDArray[np.int64]:
        """[F, 3], counter-clockwise from outside."""

    @property
    def uv(self) -> Floats:
        """Place in the colour strip [V, 2]."""

    def at(self, frame: int) -> tuple[Floats, Floats]:
        """Vertices and unit normals [V, 3]."""


@dataclass(frozen=True)
class BodyActor:
    """The skinned body."""

    body: Body
    posing: Posing
    face: Floats | None = None
    """Weights [T, 7] of the face's shapes."""

    @property
    def triangles(self) -> NDArray[np.int64]:
        """Those of the body."""
        return self.body.triangles

    @property
    def uv(self) -> Floats:
        """Those of the body."""
        return self.body.uv

    @cached_property
    def _bones(self) -> Floats:
        return self.posing.bones()

    def at(self, frame: int) -> tuple[Floats, Floats]:
        """Vertices and unit normals [V, 3]."""
        now = slice(frame, frame + 1)
        face = None if self.face is None else self.face[now]
        vertices = self.body.skinned(self._bones[now], self.posing.joints[now], face)
        return vertices[0], self.body.turned_normals(self._bones[now])[0]


@dataclass(frozen=True)
class PlainActor:
    """A tapered, round-ended tube for every bone."""

    figure: Figure
    joints: Floats

    @cached_property
    def _tube(self) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Directions [K, 3] (z along the limb) and end (0 or 1) [K] of a limb's vertices; triangles."""
        polar = np.linspace(0, np.pi / 2, _CAP + 1)
        rings = [(-np.cos(p), np.sin(p), 0.0) for p in polar] + [
            (np.cos(p), np.sin(p), 1.0) for p in polar[::-1]
        ]
        turn = 2 * np.pi * np.arange(_AROUND) / _AROUND
        away = np.concatenate(
            [
                np.column_stack([wide * np.cos(turn), wide * np.sin(turn), np.full(_AROUND, along)])
                for along, wide, _ in rings
            ]
        )
        end = np.repeat([ring[2] for ring in rings], _AROUND)
        here = np.arange((len(rings) - 1) * _AROUND)
        side = here - here % _AROUND + (here + 1) % _AROUND
        triangles = [[here, side, here + _AROUND], [side, side + _AROUND, here + _AROUND]]
        return away, end, np.concatenate([np.stack(corners, axis=1) for corners in triangles])

    @cached_property
    def triangles(self) -> NDArray[np.int64]:
        """A tube for each bone."""
        away, _, one = self._tube
        starts = len(away) * np.arange(len(self.figure.capsules))
        return np.asarray((one + starts[:, None, None]).reshape(-1, 3))

    @cached_property
    def uv(self) -> Floats:
        """The colour of the bone's side."""
        columns = [_COLUMNS[capsule.side] for capsule in self.figure.capsules]
        return np.column_stack(
            [np.repeat(columns, len(self._tube[0])), np.full(len(columns) * len(self._tube[0]), 0.125)]
        )

    def at(self, frame: int) -> tuple[Floats, Floats]:
        """Vertices and unit normals [V, 3]."""
        away, end, _ = self._tube
        capsules = self.figure.capsules
        a, b = (self.joints[frame, [getattr(c, name) for c in capsules]] for name in ("a", "b"))
        along = (b - a) / np.maximum(np.linalg.norm(b - a, axis=1, keepdims=True), 1e-9)
        along[~along.any(axis=1)] = [0.0, 1.0, 0.0]
        other = np.where(np.abs(along[:, :1]) > 0.8, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
        x = np.cross(other, along)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        axes = np.stack([x, np.cross(along, x), along], axis=1)
        normals = np.einsum("kj,cji->cki", away, axes)
        radii = np.array([[c.ra, c.rb] for c in capsules])[:, end.astype(int)]
        places = np.stack([a, b], axis=1)[:, end.astype(int)] + radii[..., None] * normals
        return places.reshape(-1, 3), normals.reshape(-1, 3)


def actor_for(
    joints: NDArray[Any],
    parents: Sequence[int],
    figure: RigidMotion | None = None,
    face_controls: NDArray[Any] | None = None,
) -> Actor:
    """Who shows joints [T, N, 3]: the body where the skeleton is a person's.

    `figure` has the joints' rotations, where they are known; `face_controls` [T, 5] are those of the viewer.
    """
    skeleton = human_skeleton(parents)
    if skeleton is None:
        return PlainActor(figure_for(parents, joints), np.asarray(joints, np.float64))
    posing = posing_of(joints, skeleton, figure)
    face = None if face_controls is None else control_weights(face_controls)
    return BodyActor(body_for(posing.skeleton, "controls", "near"), posing, face)


def draw_actor(
    image: NDArray[np.uint8], camera: Camera, target: NDArray[Any], floor: float, actor: Actor, frame: int
) -> None:
    """Paint shadow and figure onto `image` [H, W, 3] of the camera's size."""
    vertices, normals = actor.at(frame)
    cast_shadow(image, camera, target, floor - SOLE, vertices, actor.triangles)
    seen = camera.project(vertices, target)
    if seen[:, 2].min() < NEAR:
        return  # a figure the camera stands in cannot be painted
    found = cover(seen[:, :2], 1 / seen[:, 2], actor.triangles, (camera.width, camera.height))
    corners = actor.triangles[found.triangles]
    eye = np.asarray(target, np.float64) + camera.distance * camera.axes[2]
    table = np.concatenate([normals, vertices, actor.uv[:, :1]], axis=1).astype(np.float32)
    shares = found.shares.astype(np.float32)
    mixed = shares[:, :1] * table[corners[:, 0]]
    for k in (1, 2):
        mixed += shares[:, k : k + 1] * table[corners[:, k]]
    unit = mixed[:, :3] / np.maximum(np.linalg.norm(mixed[:, :3], axis=1, keepdims=True), 1e-6)
    toward = eye.astype(np.float32) - mixed[:, 3:6]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    strip = colour_strip()
    row = (actor.uv[corners[:, 0], 1] * strip.shape[0]).astype(np.int64)
    column = np.clip(mixed[:, 6] * strip.shape[1], 0, strip.shape[1] - 1).astype(np.int64)
    base = strip[row, column].astype(np.float32) / 255
    painted = row // (strip.shape[0] // 4) == _PAINTED_ROW
    image.reshape(-1, 3)[found.pixels] = np.round(255 * lit(base, unit, toward, painted))
