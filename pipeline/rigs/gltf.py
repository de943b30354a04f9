"""GLB files of others (also .vrm, .vrma), read within bounds and written again with animations.

The JSON stays as it came, whatever extensions it has. Nothing that a file names is opened: data outside of it
is refused where it is needed, and left alone where not.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import atomic_file
from motionloom.datasets.base.json_doors import parse_json, read_plain

Floats = NDArray[np.float64]

MOST_BYTES = 2**28
MOST_NODES, MOST_KEYS = 10_000, 2_000_000
"""Nodes of a file, and numbers of an animation's channel: an hour at 120 frames a second has 1.7 million."""
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_JSON = 0x4E4F534A
_BIN = 0x004E4942


@dataclass
class Gltf:
    """A file's JSON, its binary data, and the tree of its nodes."""

    where: str
    json: dict[str, Any]
    blob: bytearray
    parents: list[int] = field(default_factory=list)
    """Parent of each node, -1 for roots."""

    @staticmethod
    def read(path: Path) -> Gltf:
        """A GLB file; `UserError` for anything else, or one that contradicts itself."""
        try:
            raw = read_plain(path, MOST_BYTES)
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror})") from None
        where = str(path)
        if len(raw) < 20 or raw[:4] != b"glTF" or struct.unpack_from("<I", raw, 4)[0] != 2:
            raise UserError(f"{where}: not a GLB file (binary glTF 2.0); export it as .glb or .vrm")
        chunks: dict[int, bytes] = {}
        at = 12
        while at + 8 <= len(raw):
            size, kind = struct.unpack_from("<II", raw, at)
            if at + 8 + size > len(raw):
                raise UserError(f"{where}: cut off within a chunk")
            chunks.setdefault(kind, raw[at + 8 : at + 8 + size])
            at += 8 + size + -size % 4
        data = parse_json(chunks.get(_JSON, b""), where)
        out = Gltf(where, data if isinstance(data, dict) else {}, bytearray(chunks.get(_BIN, b"")))
        try:
            out._hang()
        except (TypeError, KeyError, AttributeError, ValueError, IndexError) as error:
            raise UserError(f"{where}: not a glTF scene ({type(error).__name__})") from None
        return out

    def _hang(self) -> None:
        """Find each node's parent. Refuses circles and nodes with two parents."""
        nodes = self.json.get("nodes", [])
        if not 0 < len(nodes) <= MOST_NODES:
            raise UserError(f"{self.where}: {len(nodes)} nodes; from 1 to {MOST_NODES:,} are read")
        self.parents = [-1] * len(nodes)
        for number, node in enumerate(nodes):
            for child in node.get("children", ()):
                if not 0 <= child < len(nodes) or self.parents[child] >= 0:
                    raise UserError(f"{self.where}: node {child} hangs on two others, or is none")
                self.parents[child] = number
        for number in range(len(nodes)):
            seen = 0
            while (number := self.parents[number]) >= 0:
                seen += 1
                if seen > len(nodes):
                    raise UserError(f"{self.where}: its nodes hang in a circle")

    def names(self) -> list[str]:
        """The name of each node."""
        return [str(node.get("name", f"node {n}"))[:200] for n, node in enumerate(self.json["nodes"])]

    def in_order(self) -> list[int]:
        """Nodes, parents before children."""
        out = [node for node, parent in enumerate(self.parents) if parent < 0]
        for node in out:
            out += self.json["nodes"][node].get("children", ())
        return out

    def local(self, node: int) -> tuple[Floats, Floats, Floats]:
        """Translation [3], rotation [3, 3] and scale [3] of a node."""
        from scipy.spatial.transform import Rotation

        about = self.json["nodes"][node]
        try:
            if "matrix" in about:
                matrix = np.array(about["matrix"], dtype=np.float64).reshape(4, 4).T
                scale = np.linalg.norm(matrix[:3, :3], axis=0)
                return matrix[:3, 3], matrix[:3, :3] / np.maximum(scale, 1e-12), scale
            place = np.array(about.get("translation", (0, 0, 0)), dtype=np.float64).reshape(3)
            turn = np.array(about.get("rotation", (0, 0, 0, 1)), dtype=np.float64).reshape(4)
            scale = np.array(about.get("scale", (1, 1, 1)), dtype=np.float64).reshape(3)
            return place, Rotation.from_quat(turn).as_matrix(), scale
        except (TypeError, ValueError):
            raise UserError(f"{self.where}: node {node} has no place that can be read") from None

    def worlds(self) -> Floats:
        """World matrices of all nodes [N, 4, 4], as they stand in the file."""
        out = np.tile(np.eye(4), (len(self.parents), 1, 1))
        for node in self.in_order():
            place, turn, scale = self.local(node)
            out[node, :3, :3] = turn * scale
            out[node, :3, 3] = place
            if self.parents[node] >= 0:
                out[node] = out[self.parents[node]] @ out[node]
        return out

    def values(self, accessor: int) -> Floats:
        """The numbers of an accessor [count, width]."""
        try:
            about = self.json["accessors"][accessor]
            width = _WIDTHS[about["type"]]
            kind = np.dtype(_KINDS[about["componentType"]])
            count = int(about["count"])
            if not 0 < count <= MOST_KEYS or "sparse" in about:
                raise ValueError("a count beyond bounds, or sparse numbers")
            if "bufferView" not in about:
                return np.zeros((count, width))
            view = self.json["bufferViews"][about["bufferView"]]
            if view.get("buffer", 0) != 0 or self.json["buffers"][0].get("uri") or view.get("extensions"):
                raise ValueError("packed, or in another file")
            stride = int(view.get("byteStride", 0)) or width * kind.itemsize
            start = int(view.get("byteOffset", 0)) + int(about.get("byteOffset", 0))
            end = start + stride * (count - 1) + width * kind.itemsize
            if not 0 <= start <= end <= len(self.blob) or stride < width * kind.itemsize:
                raise ValueError("beyond the file's data")
            flat = np.frombuffer(self.blob[start:end], "u1")
            rows = np.lib.stride_tricks.as_strided(flat, (count, width * kind.itemsize), (stride, 1))
            found = np.ascontiguousarray(rows).view(kind).astype(np.float64)
            if about.get("normalized"):
                found /= np.iinfo(kind).max
            if not np.isfinite(found).all():
                raise ValueError("not finite")
            return found
        except (TypeError, KeyError, ValueError, IndexError, AttributeError) as error:
            raise UserError(f"{self.where}: accessor {accessor} cannot be read ({error})") from None

    def add(self, values: NDArray[np.generic], *, bounds: bool = False) -> int:
        """Number of a new accessor of float32 values [count, width]."""
        data = np.ascontiguousarray(values, dtype="<f4")
        self.blob += bytes(-len(self.blob) % 4)
        views = self.json.setdefault("bufferViews", [])
        views.append({"buffer": 0, "byteOffset": len(self.blob), "byteLength": data.nbytes})
        self.blob += data.tobytes()
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[data.shape[1]]
        about: dict[str, Any] = {
            "bufferView": len(views) - 1, "componentType": 5126, "count": len(data), "type": kind,
        }  # fmt: skip
        if bounds:
            about |= {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
        accessors = self.json.setdefault("accessors", [])
        accessors.append(about)
        return len(accessors) - 1

    def animate(self, name: str, fps: float, tracks: dict[tuple[int, str], Floats]) -> None:
        """Add an animation: values [T, W] of nodes' `rotation` (quaternions), `translation` or `weights`."""
        frames = max(len(values) for values in tracks.values())
        every = self.add(np.arange(frames)[:, None] / fps, bounds=True)
        first: list[int] = []
        animation: dict[str, Any] = {"name": name, "channels": [], "samplers": [], "extras": {"fps": fps}}
        for (node, path), values in tracks.items():
            still = not (values != values[:1]).any()
            kept = values[:1] if still else values
            if still and not first:
                first.append(self.add(np.zeros((1, 1)), bounds=True))
            if path == "rotation":
                kept = _without_flips(kept)
            output = self.add(kept.reshape(-1, 1) if path == "weights" else kept)
            animation["channels"].append(
                {"sampler": len(animation["samplers"]), "target": {"node": node, "path": path}}
            )
            animation["samplers"].append(
                {"input": first[0] if still else every, "output": output, "interpolation": "LINEAR"}
            )
        self.json.setdefault("animations", []).append(animation)

    def write(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        with atomic_file(path) as file:
            file.write(self.to_bytes())

    def to_bytes(self) -> bytes:
        """The file; `UserError` where its data is not in it."""
        self.blob += bytes(-len(self.blob) % 4)
        own, *others = self.json.get("buffers") or [{}]
        if own.get("uri"):
            raise UserError(f"{self.where}: its data lies in another file; export it as one .glb")
        self.json["buffers"] = [{**own, "byteLength": len(self.blob)}, *others]
        text = json.dumps(self.json, ensure_ascii=False, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), _JSON) + text
        if self.blob:
            chunks += struct.pack("<II", len(self.blob), _BIN) + bytes(self.blob)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _without_flips(turns: Floats) -> Floats:
    """Quaternions [T, 4] with signs such that players take the short way between two of them."""
    signs = np.sign(np.einsum("tq,tq->t", turns[1:], turns[:-1]))
    return np.asarray(turns * np.concatenate([[1.0], np.cumprod(np.where(signs < 0, -1.0, 1.0))])[:, None])
