"""The formats of this folder; what writes them is imported when something is written."""

from __future__ import annotations

from pathlib import Path

from motionloom.datasets.base.register import register
from motionloom.pipeline.inference.files.writers import Outputs, Writer


def _write_vrma(path: Path, outputs: Outputs) -> None:
    from motionloom.pipeline.rigs.vrma import write_vrma

    write_vrma(path, outputs)


def _write_rig(path: Path, outputs: Outputs) -> list[str]:
    from motionloom.pipeline.rigs.rig_file import write_rig

    return write_rig(path, outputs)


def _write_page(path: Path, outputs: Outputs) -> list[str]:
    from motionloom.pipeline.rigs.page import write_rig_page

    return write_rig_page(path, outputs)


_GLB = "model/gltf-binary"
_OPTIONS = {"rig": "your .vrm or .glb", "rig_map": "names of its joints (JSON)"}
register(Writer("vrma", ".vrma", _GLB, "VRM animation, for any VRM character", _write_vrma))
register(
    Writer(
        "rig", "_rig.glb", _GLB, "your own character, as GLB", _write_rig, "rig.glb",
        options=_OPTIONS,
    )
)  # fmt: skip
register(
    Writer(
        "rig-page", "_rig.html", "text/html; charset=utf-8", "a page with your own character (--set rig)",
        _write_page, "rig.html", False, options=dict.fromkeys(_OPTIONS, ""),
    )
)  # fmt: skip
