"""The format `rig-page`: one self-contained page on which the user's own character moves.

The character travels whole, in base64; the script beside it has 15 kB and opens nothing. Titles and names are
untrusted: they enter the page as JSON without `<`, `>` and `&`, and the screen through `textContent`.
"""

from __future__ import annotations

import base64
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np

from motionloom.datasets.base.files import write_text
from motionloom.pipeline.inference.files.writers import Outputs
from motionloom.pipeline.render.viewer import fill, safe_json
from motionloom.pipeline.rigs.rig_file import put_on, rig_of

_CROWN = 1.4
"""From the floor to the head's joint, to the crown of a big head."""


def write_rig_page(path: Path, outputs: Outputs) -> list[str]:
    """Write the page with all clips; returns sentences on what the character lacks."""
    rig = rig_of(outputs.clips[0])
    rig.gltf.json.pop("animations", None)
    said = put_on(rig, list(outputs.clips))
    packed = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")
    if any(name in packed for name in rig.gltf.json.get("extensionsRequired") or ()):
        said.append(f"{Path(rig.gltf.where).name}: its meshes are packed: the page draws none")
    rest = rig.skeleton.rest_joints[:, 1]
    tall = (
        float(rest[rig.skeleton.index("head")] - rest[rig.skeleton.index("left_foot")]) * rig.unit + rig.ball
    )
    ahead = rig.ahead.T @ [0.0, 0.0, 1.0]
    web = resources.files("motionloom.pipeline.rigs") / "web"
    data = {
        "title": outputs.title,
        "note": "\n".join([outputs.note, *said]),
        "hips": rig.nodes["pelvis"],
        "size": _CROWN * tall,
        "ahead": float(np.arctan2(ahead[0], ahead[2])),
        "glb": base64.b64encode(rig.gltf.to_bytes()).decode("ascii"),
    }
    page = fill(
        (web / "rig.html").read_text(encoding="utf-8"),
        TITLE=escape(outputs.title),
        DATA=safe_json(data),
        SCRIPT=(web / "rig.js").read_text(encoding="utf-8"),
    )
    write_text(path, page)
    return said
