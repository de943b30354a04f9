"""Which node of a character stands for which of our joints, and which shape of its face for which expression.

VRM files say it themselves. Others are known by the names of their makers (`datasets/convert/bvh/tools.csv`:
Mixamo, Rigify, Unreal and more), or by a JSON file of one's own: `{"pelvis": "Bip01", "left_hip": "..."}`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError, nearest
from motionloom.datasets.base.json_doors import parse_json, read_plain
from motionloom.datasets.convert.bvh.joint_guess import guess_joint_map
from motionloom.datasets.motion.bvh.motion import BvhMotion
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body.face import ARKIT, EXPRESSIONS
from motionloom.pipeline.rigs.gltf import Gltf

WHOLE = Skeleton.named("smplx52")
NEEDED = (
    "pelvis", "head",
    *(f"{side}_{name}" for side in ("left", "right")
      for name in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")),
)  # fmt: skip
"""Joints without which a character is no person."""

_BODY = {
    "hips": "pelvis", "spine": "spine1", "chest": "spine2", "upperChest": "spine3", "neck": "neck",
    "head": "head",
}  # fmt: skip
_SIDED = {
    "Shoulder": "collar", "UpperArm": "shoulder", "LowerArm": "elbow", "Hand": "wrist",
    "UpperLeg": "hip", "LowerLeg": "knee", "Foot": "ankle", "Toes": "foot",
}  # fmt: skip
_FINGERS = {"Index": "index", "Middle": "middle", "Ring": "ring", "Little": "pinky"}


def _humanoid() -> dict[str, str]:
    """VRM 1.0's humanoid bones -> our joints."""
    out = dict(_BODY)
    for side in ("left", "right"):
        out |= {f"{side}{bone}": f"{side}_{joint}" for bone, joint in _SIDED.items()}
        for finger, joint in _FINGERS.items():
            for number, bone in enumerate(("Proximal", "Intermediate", "Distal"), 1):
                out[f"{side}{finger}{bone}"] = f"{side}_{joint}{number}"
        for number, bone in enumerate(("Metacarpal", "Proximal", "Distal"), 1):
            out[f"{side}Thumb{bone}"] = f"{side}_thumb{number}"
    return out


HUMANOID = _humanoid()
PRESETS = {
    "happy": "happy", "sad": "sad", "angry": "angry", "surprised": "surprised", "blink": "blink",
    "aa": "talk_open", "ih": "talk_wide", "ou": "talk_purse",
}  # fmt: skip
"""VRM 1.0's preset expressions -> those of `EXPRESSIONS`."""
_OTHERS = {
    "joy": "happy", "sorrow": "sad", "a": "talk_open", "i": "talk_wide", "u": "talk_purse",
    "smile": "happy", "mouthsmile": "happy", "mouthopen": "talk_open", "visemeaa": "talk_open",
    "eyesclosed": "blink", "eyeblink": "blink",
}  # fmt: skip
"""Other makers' words for them: VRM 0.x, VRoid, Ready Player Me."""


def nodes_of(gltf: Gltf, places: NDArray[np.float64], own: Path | None = None) -> dict[str, int]:
    """Our joints -> nodes of a file, whose nodes stand upright at `places` [N, 3].

    `own` is a JSON file of names that count before all others. `UserError` where joints are not found that
    every person has.
    """
    extensions = gltf.json.get("extensions") or {}
    found = _stated(gltf, extensions) or _guessed(gltf, places)
    names = gltf.names()
    for joint, name in _written(own).items():
        if joint not in WHOLE.joints:
            raise UserError(f"{own}: no joint '{joint}'{nearest(joint, list(WHOLE.joints))}")
        if name is None:
            found.pop(joint, None)
        elif names.count(str(name)) != 1:
            near = nearest(str(name), names)
            raise UserError(f"{own}: {joint}: {gltf.where} has no single node '{name}'{near}")
        else:
            found[joint] = names.index(str(name))
    if missing := [joint for joint in NEEDED if joint not in found]:
        more = " and more" * (len(missing) > 4)
        raise UserError(
            f"{gltf.where}: no node for {', '.join(missing[:4])}{more}: name them in a JSON file, "
            '--set rig_map=FILE: {"pelvis": "NAME OF A NODE", ...}'
        )
    return found


def _written(own: Path | None) -> dict[str, object]:
    if own is None:
        return {}
    found = parse_json(read_plain(own, 2**20), str(own))
    if not isinstance(found, dict):
        raise UserError(f'{own}: a map of a rig is {{"pelvis": "NAME OF A NODE", ...}}')
    return found


def _stated(gltf: Gltf, extensions: dict[str, object]) -> dict[str, int]:
    """What a VRM file says; nothing for others."""
    out: dict[str, int] = {}
    try:
        for key in ("VRMC_vrm", "VRMC_vrm_animation", "VRM"):
            if not isinstance(about := extensions.get(key), dict):
                continue
            bones = about["humanoid"]["humanBones"]
            if isinstance(bones, list):  # VRM 0.x, whose thumbs are named one joint further out
                bones = {_thumb(one["bone"]): one for one in bones}
            for bone, place in bones.items():
                if bone in HUMANOID and 0 <= place["node"] < len(gltf.parents):
                    out[HUMANOID[bone]] = int(place["node"])
            # Arms hang on the highest joint of a spine, which is our third.
            highest = next((joint for joint in ("spine3", "spine2", "spine1") if joint in out), "spine3")
            if highest in out:
                out["spine3"] = out.pop(highest)
    except (TypeError, KeyError, AttributeError, ValueError) as error:
        raise UserError(f"{gltf.where}: its VRM bones cannot be read ({type(error).__name__})") from None
    return out


def _thumb(bone: str) -> str:
    if "ThumbProximal" in bone:
        return bone.replace("Proximal", "Metacarpal")
    return bone.replace("ThumbIntermediate", "ThumbProximal")


def _guessed(gltf: Gltf, places: NDArray[np.float64]) -> dict[str, int]:
    """What names of common tools say."""
    order = gltf.in_order()
    names = gltf.names()
    row = {node: number for number, node in enumerate(order, 1)}
    parents = tuple(row.get(gltf.parents[node], 0) for node in order)
    above = np.concatenate([np.zeros((1, 3)), places[order]])
    offsets = above[1:] - above[list(parents)]
    figure = BvhMotion(
        name=gltf.where,
        joints=("", *(names[node] for node in order)),
        parents=(-1, *parents),
        offsets=np.concatenate([np.zeros((1, 3)), offsets]),
        channels=((),) * (len(order) + 1),
        values=np.zeros((1, 0)),
        fps=30.0,
    )
    out: dict[str, int] = {}
    guess = guess_joint_map(figure, WHOLE)
    for joint, sources in zip(WHOLE.joints, guess.sources, strict=True):
        if len(set(sources)) == 1 and names.count(sources[0]) == 1:
            out.setdefault(joint, names.index(sources[0]))
    return out


def shape_word(name: str) -> str:
    """The expression of `ARKIT` or `EXPRESSIONS` that a shape's name means; empty for none."""
    sided = re.sub(r"[_.\- ][lL]$", "Left", re.sub(r"[_.\- ][rR]$", "Right", name))
    plain = re.sub(r"[^a-z0-9]", "", sided.lower())
    return _SHAPES.get(plain, "")


_SHAPES = {
    **_OTHERS,
    **PRESETS,
    **{name.replace("_", ""): name for name in EXPRESSIONS},
    **{name.lower(): name for name in ARKIT},
}
