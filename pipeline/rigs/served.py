"""The user's own character on the page of `motionloom serve --rig`."""

from __future__ import annotations

from importlib import resources

from motionloom.datasets.base.register import register
from motionloom.pipeline.rigs.rig import Rig
from motionloom.pipeline.serve.part import Host, OpenPart, ServedPart


def _open(host: Host) -> OpenPart:
    """`UserError` for a character that cannot be read."""
    config = host.config
    if config.rig is not None:
        Rig.read(config.rig, config.rig_map)
    return OpenPart({}, {"possible": config.rig is not None})


register(ServedPart("character", resources.files("motionloom.pipeline.rigs") / "web", _open))
