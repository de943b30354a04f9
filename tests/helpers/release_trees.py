"""Tiny trees in the layouts in which sets are published, all with the walk of `amass_clips`, Y up."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import soundfile
from amass_clips import walk as walk_z_up
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.body.smpl import BodyModel
from motionloom.datasets.motion.skeleton import Skeleton

FPS, SECONDS = 30.0, 3.0

Floats = NDArray[np.float64]


def walk(bent: float = 0.0) -> tuple[Floats, Floats]:
    """Axis-angles [T, 52, 3] and translation [T, 3] of a walk to the left, Y up; `bent` tells them apart."""
    clip = walk_z_up(FPS, SECONDS)
    poses = clip["poses"].reshape(-1, 52, 3)
    flat = Rotation.from_rotvec([-np.pi / 2, 0, 0])
    pelvis = BodyModel.neutral("smplx52").rest_joints()[0]
    poses[:, 5, 0] += bent
    poses[:, 0] = (flat * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return poses, flat.apply(clip["trans"] + pelvis) - pelvis


def put(path: Path, content: object) -> Path:
    """Text as it is, anything else as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def sing(path: Path, seconds: float = SECONDS + 0.2) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    times = np.arange(int(seconds * 8000)) / 8000
    soundfile.write(path, 0.2 * np.sin(2 * np.pi * 220 * times), 8000)


def rows_of(rotvecs: Floats) -> Floats:
    """[T, N, 3] -> the first two rows of the rotation matrices [T, N, 6], one joint after the other."""
    out = np.empty((*rotvecs.shape[:2], 6))
    for joint in range(rotvecs.shape[1]):
        out[:, joint] = Rotation.from_rotvec(rotvecs[:, joint]).as_matrix()[:, :2].reshape(-1, 6)
    return out


def motionhub(root: Path) -> Path:
    """Four motions: a captioned one, a dance in two lists, a talk, and one that is listed but not there."""
    lists: dict[str, dict[str, Any]] = {}
    for name, split, task, more in (
        ("HumanML3D_AMASS/smplh_52/000/000001", "train", "text_motion", {}),
        ("aist/smplh_52/gBR_1", "train", "text_motion", {}),
        ("aist/smplh_52/gBR_1", "test", "music_dance", {"music_path": "aist/music/m.wav", "genre": "break"}),
        ("ted_db/smplh_52/talk", "train", "speech_gesture",
         {"audio_path": "ted_db/audio/talk.wav", "speech_script_path": "ted_db/script/talk.txt"}),
        ("hi4d/smplh_52/gone", "train", "two_person_interaction", {"interactor_key": "other"}),
    ):  # fmt: skip
        caption = name.replace("smplh_52", "hierarchical_caption") + ".json"
        row = {"smplh_path": f"{name}.npz", "hierarchical_caption_path": caption, "fps": 30.0, **more}
        lists.setdefault(f"{task}/{split}", {})[name.rsplit("/", 1)[-1]] = row
        put(root / caption, {"macro": ["a person walks"], "meso": ["someone walks to the left"], "micro": []})
        if "gone" not in name:
            poses, trans = walk({"000001": 0.0, "gBR_1": 0.3}.get(name.rsplit("/", 1)[-1], 0.6))
            translation = {"transl" if "talk" in name else "trans": trans}
            path = root / f"{name}.npz"
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(path, poses=poses.reshape(-1, 156), betas=np.zeros(10), **translation)
    for place, rows in lists.items():
        put(root / f"annotations/{place}.json", {"meta_info": {}, "data_list": rows})
    sing(root / "aist/music/m.wav")
    sing(root / "ted_db/audio/talk.wav")
    put(root / "ted_db/script/talk.txt", "so this is how we walk")
    return root


def finedance(root: Path) -> Path:
    """Two dances, of which one has music, and one of the authors' list of bad ones."""
    (root / "motion").mkdir(parents=True)
    for number in ("001", "063", "116"):
        poses, trans = walk(float(number != "001") * 0.3)
        values = np.concatenate([trans, rows_of(poses).reshape(len(poses), -1)], axis=1)
        np.save(root / f"motion/{number}.npy", values.astype(np.float32))
        put(root / f"label_json/{number}.json", {"name": "song", "style1": "Street", "style2": "Breaking"})
    sing(root / "music_wav/001.wav")
    return root


_FINGERS = ("Thumb", "Index", "Middle", "Ring", "Pinky")


def soma() -> list[tuple[str, str]]:
    """The 77 joints of SOMA with their parents, parents first."""
    body = "Hips: Spine1 Spine2 Chest Neck1 Neck2 Head HeadEnd"
    chains = [body, "Head: Jaw", "Head: LeftEye", "Head: RightEye"]
    for side in ("Left", "Right"):
        chains.append("Chest: " + " ".join(side + name for name in ("Shoulder", "Arm", "ForeArm", "Hand")))
        for finger in _FINGERS:
            ends = ("1", "2", "3", "End") if finger == "Thumb" else ("1", "2", "3", "4", "End")
            chains.append(f"{side}Hand: " + " ".join(f"{side}Hand{finger}{end}" for end in ends))
        chains.append(
            "Hips: " + " ".join(side + name for name in ("Leg", "Shin", "Foot", "ToeBase", "ToeEnd"))
        )
    joints = [("Hips", "")]
    for chain in chains:
        parent, names = chain.split(": ")
        for name in names.split():
            joints.append((name, parent))
            parent = name
    return joints


def soma_of(name: str) -> str:
    """The joint of SOMA that one of `smplx52` is."""
    side, _, part = name.partition("_")
    body = {
        "pelvis": "Hips",
        "spine1": "Spine1",
        "spine2": "Spine2",
        "spine3": "Chest",
        "neck": "Neck1",
        "head": "Head",
    }
    limb = {"hip": "Leg", "knee": "Shin", "ankle": "Foot", "foot": "ToeBase", "collar": "Shoulder",
            "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand"}  # fmt: skip
    if name in body:
        return body[name]
    if part in limb:
        return side.title() + limb[part]
    finger, number = part[:-1].title(), int(part[-1])
    return f"{side.title()}Hand{finger}{number + (finger != 'Thumb')}"


@lru_cache
def soma_file(fps: float = 120.0) -> str:
    """The walk on SOMA's joints, in centimetres, in a zero pose that has nothing to do with a T-pose."""
    skeleton = Skeleton.named("smplx52")
    poses, trans = walk()
    at = np.arange(int(SECONDS * fps)) / fps * FPS
    low = np.minimum(at.astype(int), len(poses) - 2)
    weight = (at - low)[:, None, None]
    poses = (1 - weight) * poses[low] + weight * poses[low + 1]
    trans = (1 - weight[:, 0]) * trans[low] + weight[:, 0] * trans[low + 1]
    local = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(len(poses), 52, 3, 3)
    body = BodyModel.neutral("smplx52")
    ours = {soma_of(name): number for number, name in enumerate(skeleton.joints)}
    joints = soma()
    names = [name for name, _ in joints]
    rng = np.random.default_rng(7)
    zero = Rotation.random(len(names), random_state=rng).as_matrix()
    zero[0] = np.eye(3)
    rest, offsets, turned = {}, {}, {}
    lines: dict[str, NDArray[Any]] = {}
    for number, (name, parent) in enumerate(joints):
        above = names.index(parent) if parent else None
        at_rest = body.template[ours[name]] if name in ours else rest[parent] + [0.0, 0.02, 0.03]
        rest[name] = at_rest
        if above is None:
            offsets[name], turned[name] = np.zeros(3), local[:, 0]
            lines[name] = turned[name]
            continue
        # A joint between two of ours takes the bone of the next: it must move with its parent.
        turned[name] = turned[parent] @ local[:, ours[name]] if name in ours else turned[parent]
        offsets[name] = zero[above].T @ (at_rest - rest[parent])
        lines[name] = (turned[parent] @ zero[above]).transpose(0, 2, 1) @ (turned[name] @ zero[number])
    return _bvh(joints, offsets, lines, trans + body.template[0], fps)


def _bvh(
    joints: list[tuple[str, str]],
    offsets: dict[str, Floats],
    rotations: dict[str, Floats],
    root: Floats,
    fps: float,
) -> str:
    """A BVH file in centimetres, every rotation as Z, Y, X."""
    order: list[str] = []

    def block(name: str, depth: int) -> list[str]:
        order.append(name)
        pad = "  " * depth
        channels = "6 Xposition Yposition Zposition" if not depth else "3"
        out = [f"{pad}{'JOINT' if depth else 'ROOT'} {name}", f"{pad}{{"]
        out.append(f"{pad}  OFFSET " + " ".join(f"{value * 100:.9f}" for value in offsets[name]))
        out.append(f"{pad}  CHANNELS {channels} Zrotation Yrotation Xrotation")
        below = [child for child, parent in joints if parent == name]
        for child in below:
            out += block(child, depth + 1)
        if not below:
            out += [f"{pad}  End Site", f"{pad}  {{", f"{pad}    OFFSET 0 0 1", f"{pad}  }}"]
        return [*out, f"{pad}}}"]

    text = [
        "HIERARCHY",
        *block(joints[0][0], 0),
        "MOTION",
        f"Frames: {len(root)}",
        f"Frame Time: {1 / fps:.9f}",
    ]
    turns = [Rotation.from_matrix(rotations[name]).as_euler("ZYX", degrees=True) for name in order]
    for row in np.concatenate([root * 100, *turns], axis=1):
        text.append(" ".join(f"{value:.9f}" for value in row))
    return "\n".join(text) + "\n"


def bones_seed(root: Path) -> Path:
    """Two takes of two actors and a mirrored one, of which one has a timeline."""
    header = "filename,move_name,move_duration_frames,category,is_mirror,actor_uid,content_natural_desc_1"
    rows = ["walk_001__A1,walk_001,360,Dances,False,A1,A person walks to the left.",
            "walk_001__A1_M,walk_001,360,Dances,True,A1,A person walks to the right.",
            'talk_002__A2,talk_002,360,Baseline,False,A2,"A person walks, and talks."',
            "gone_003__A2,gone_003,360,Baseline,False,A2,Nobody."]  # fmt: skip
    put(root / "metadata/seed_metadata_v004.csv", "\n".join([header, *rows]) + "\n")
    events = [{"start_time": 0.0, "end_time": 1.5, "description": "starts"},
              {"start_time": 1.5, "end_time": 3.2, "description": "goes on"}]  # fmt: skip
    record = json.dumps({"filename": "walk_001__A1", "events": events})
    put(root / "metadata/seed_metadata_v002_temporal_labels.jsonl", record + "\n")
    for number, name in enumerate(("walk_001__A1", "walk_001__A1_M", "talk_002__A2")):
        lines = "\n" * number  # no two files have the same bytes
        put(root / f"soma_uniform/bvh/24010{number}/{name}.bvh", soma_file() + lines)
    return root
