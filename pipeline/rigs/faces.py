"""Faces of motions as weights of a character's shapes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.pipeline.inference.files.writers import OutputClip
from motionloom.pipeline.render.body.face import ARKIT, EXPRESSIONS, expression_weights
from motionloom.pipeline.rigs.gltf import Gltf
from motionloom.pipeline.rigs.names import shape_word

Floats = NDArray[np.float64]
_MOST_SHAPES = 10_000


def face_values(clip: OutputClip) -> dict[str, Floats]:
    """Weights [T] in 0..1 by the names of `EXPRESSIONS` and `ARKIT`; none for a motion without a face."""
    if clip.face is None:
        return {}
    emotions = np.clip(expression_weights(clip.face), 0, 1)
    return dict(zip((*EXPRESSIONS, *ARKIT), [*emotions.T, *clip.arkit_weights().T], strict=True))


def face_tracks(gltf: Gltf, values: dict[str, Floats]) -> dict[tuple[int, str], Floats]:
    """Weights [T, S] of the shapes of each node whose mesh has some that are known.

    A mesh with ARKit's shapes moves by these alone, another by what its VRM expressions bind, or by its
    shapes' names.
    """
    if not values:
        return {}
    binds = _bound_shapes(gltf)
    out: dict[tuple[int, str], Floats] = {}
    for number, node in enumerate(gltf.json["nodes"]):
        names = _shapes_of(gltf, node)
        words = [shape_word(name) for name in names]
        has_arkit = sum(word in ARKIT for word in words) > len(ARKIT) // 2
        weights = np.zeros((len(next(iter(values.values()))), len(names)))
        for shape, word in enumerate(words):
            if has_arkit:
                if word in ARKIT:
                    weights[:, shape] = values[word]
                continue
            for expression, share in binds.get((number, shape), ()):
                weights[:, shape] += share * values[expression]
            if not binds and word:
                weights[:, shape] = values[word]
        if weights.any():
            out[number, "weights"] = np.clip(weights, 0, 1)
    return out


def _shapes_of(gltf: Gltf, node: dict[str, Any]) -> list[str]:
    """Names of the shapes of a node's mesh, `shape 0` where they have none."""
    try:
        mesh = gltf.json["meshes"][node["mesh"]]
        first = mesh["primitives"][0]
        count = min(len(first["targets"]), _MOST_SHAPES)
        named = [(one.get("extras") or {}).get("targetNames") for one in (mesh, first)]
        named = named[0] or named[1] or []
        return [str(named[n]) if n < len(named) else f"shape {n}" for n in range(count)]
    except (KeyError, TypeError, IndexError, AttributeError):
        return []


def _bound_shapes(gltf: Gltf) -> dict[tuple[int, int], list[tuple[str, float]]]:
    """By node and shape: which expressions move it, and how far."""
    out: dict[tuple[int, int], list[tuple[str, float]]] = {}
    extensions = gltf.json.get("extensions") or {}
    try:
        expressions = (extensions.get("VRMC_vrm") or {}).get("expressions") or {}
        for group in ("preset", "custom"):
            for name, about in (expressions.get(group) or {}).items():
                for bind in about.get("morphTargetBinds") or ():
                    place = int(bind["node"]), int(bind["index"])
                    _take(out, place, name, float(bind.get("weight", 1)))
        for about in ((extensions.get("VRM") or {}).get("blendShapeMaster") or {}).get(
            "blendShapeGroups"
        ) or ():
            name = about.get("presetName") or "unknown"
            name = about.get("name", "") if name == "unknown" else name
            for bind in about.get("binds") or ():
                for number, node in enumerate(gltf.json["nodes"]):
                    if node.get("mesh") == bind["mesh"]:
                        _take(out, (number, int(bind["index"])), name, float(bind.get("weight", 100)) / 100)
    except (KeyError, TypeError, ValueError, AttributeError):
        return {}
    return out


def _take(
    out: dict[tuple[int, int], list[tuple[str, float]]], place: tuple[int, int], name: str, share: float
) -> None:
    word = shape_word(name)
    if word in EXPRESSIONS:
        out.setdefault(place, []).append((word, share))
