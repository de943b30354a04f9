"""The format `rig`: the user's own character as a GLB file, each motion an animation of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.inference.files.writers import OutputClip, Outputs
from motionloom.pipeline.rigs.faces import face_tracks, face_values
from motionloom.pipeline.rigs.rig import Rig


def rig_of(clip: OutputClip) -> Rig:
    """The character that the user has named."""
    own = clip.options.more
    if own.get("rig") is None:
        raise UserError("--format rig needs your character: --rig FILE, a .vrm or .glb")
    return Rig.read(Path(str(own["rig"])), None if own.get("rig_map") is None else Path(str(own["rig_map"])))


def put_on(rig: Rig, clips: list[OutputClip]) -> list[str]:
    """Add clips to a character as animations; returns sentences on what it lacks."""
    said = rig.lacks()
    names: set[str] = set()
    for number, clip in enumerate(clips, 1):
        figure = clip.shown.figure
        values = face_values(clip)
        if not (np.isfinite(figure.rotations).all() and np.isfinite(figure.root).all()):
            raise UserError(f"'{clip.shown.motion.caption}' holds NaN or infinite values; a GLB file cannot")
        faces = face_tracks(rig.gltf, values)
        if values and not faces:
            said.append("it has no shapes of a face that are known by name")
        name = (
            f"{clip.name} ({number})" if clip.name in names else clip.name
        )  # tools tell animations apart by name
        names.add(name)
        rig.gltf.animate(name, clip.shown.fps, {**rig.tracks(figure), **faces})
    return [f"{Path(rig.gltf.where).name}: {line}" for line in dict.fromkeys(said)]


def write_rig(path: Path, outputs: Outputs) -> list[str]:
    """The character with the clips as its animations, its own ones left out."""
    rig = rig_of(outputs.clips[0])
    rig.gltf.json.pop("animations", None)
    said = put_on(rig, list(outputs.clips))
    rig.gltf.write(path)
    return said
