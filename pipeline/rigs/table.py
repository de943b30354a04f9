"""The formats, the converter and the readers of this folder: which module registers each."""

from __future__ import annotations

from motionloom.datasets.base.register import declare

_HERE = "motionloom.pipeline.rigs"

declare("converter", {"glb": f"{_HERE}.convert"})
declare("reader of clips", dict.fromkeys((".vrm", ".vrma", ".animation"), f"{_HERE}.convert"))
declare("writer", dict.fromkeys(("vrma", "rig", "rig-page"), f"{_HERE}.formats"))
declare("part of the server", {"character": f"{_HERE}.served"})
