"""Tiny trees in the layouts in which sets are published, all with the walk of `amass_clips`, Y up."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import soundfile
from amass_clips import walk as walk_z_up
from foreign_figures import build, bvh_text
from foreign_tools import FOREIGN
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.motion.body.smpl import BodyModel, smpl_joints
from motionloom.datasets.motion.skeleton import Skeleton

FPS, SECONDS = 30.0, 3.0
BY_TOOL = {spec.tool: spec for spec in FOREIGN}

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
    """A captioned motion and its mirror image, a dance in two lists, a talk, and one that is not there."""
    bent = {"000001": 0.0, "gBR_1": 0.3, "M000001": 0.9}
    lists: dict[str, dict[str, Any]] = {}
    for name, split, task, more in (
        ("HumanML3D_AMASS/smplh_52/000/000001", "train", "text_motion", {}),
        ("HumanML3D_AMASS/smplh_52/M000/M000001", "train", "text_motion", {}),
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
            poses, trans = walk(bent.get(name.rsplit("/", 1)[-1], 0.6))
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


@lru_cache
def bvh_file(tool: str, fps: float, before: int = 0) -> str:
    """The walk on a tool's skeleton, in centimetres, in a zero pose that has nothing to do with a T-pose.

    Before and after it the figure stands still for some frames.
    """
    poses, trans = walk()
    at = np.minimum(np.arange(int(SECONDS * fps) + 1) / fps * FPS, len(poses) - 1.0)
    at = np.concatenate([np.zeros(before), at, np.full(before, len(poses) - 1.0)])
    low = np.minimum(at.astype(int), len(poses) - 2)
    weight = (at - low)[:, None, None]
    poses = (1 - weight) * poses[low] + weight * poses[low + 1]
    trans = (1 - weight[:, 0]) * trans[low] + weight[:, 0] * trans[low + 1]
    built, skeleton = build(BY_TOOL[tool]), Skeleton.named("smplx52")
    local = np.broadcast_to(np.eye(3), (len(poses), len(built.names), 3, 3)).copy()
    for joint, sources in built.ours.items():
        turns = Rotation.from_rotvec(poses[:, skeleton.index(joint)]).as_matrix()
        local[:, built.names.index(sources[0])] = turns
    pelvis = built.points[built.names.index("Hips")] - built.points[0]
    axes = Rotation.random(len(built.names), random_state=np.random.default_rng(7)).as_matrix()
    return bvh_text(built, local, trans + skeleton.rest_joints[0] - pelvis, axes, fps=fps)[0]


def bones_seed(root: Path) -> Path:
    """Two takes of two actors and a mirrored one, of which one has a timeline."""
    header = "filename,move_name,move_duration_frames,category,is_mirror,actor_uid,content_natural_desc_1"
    rows = ["walk_001__A1,walk_001,361,Dances,False,A1,A person walks to the left.",
            "walk_001__A1_M,walk_001,361,Dances,True,A1,A person walks to the right.",
            'talk_002__A2,talk_002,361,Baseline,False,A2,"A person walks, and talks."',
            "gone_003__A2,gone_003,361,Baseline,False,A2,Nobody."]  # fmt: skip
    put(root / "metadata/seed_metadata_v004.csv", "\n".join([header, *rows]) + "\n")
    events = [{"start_time": 0.0, "end_time": 1.5, "description": "starts"},
              {"start_time": 1.5, "end_time": 3.2, "description": "goes on"}]  # fmt: skip
    record = json.dumps({"filename": "walk_001__A1", "events": events})
    put(root / "metadata/seed_metadata_v002_temporal_labels.jsonl", record + "\n")
    for number, name in enumerate(("walk_001__A1", "walk_001__A1_M", "talk_002__A2")):
        lines = "\n" * number  # no two files have the same bytes
        put(root / f"soma_uniform/bvh/24010{number}/{name}.bvh", bvh_file("BONES, SOMA 77", 120.0) + lines)
    return root


def _about_y(angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def _posed(bent: float) -> tuple[Floats, Floats]:
    """Joints [T, 22, 3] of the walk on the floor, first root above the origin; headings [T] to undo."""
    poses, trans = walk(bent)
    joints = smpl_joints(poses[:, :22], trans, BodyModel.neutral("smpl22"))
    origin = joints[0, 0] * [1, 0, 1] + [0, joints[..., 1].min(), 0]
    turned = Rotation.from_rotvec(poses[:, 0]).as_matrix()
    return joints - origin, -np.arctan2(turned[:, 0, 2], turned[:, 2, 2])


def encode_272(bent: float = 0.0) -> Floats:
    """Columns [T, 272] of the walk, frame by frame and in float64; rotations are left at 0."""
    joints, angles = _posed(bent)
    out = np.zeros((len(joints), 272))
    for t, angle in enumerate(angles):
        own = [_about_y(angle) @ (joint - joints[t, 0] * [1, 0, 1]) for joint in joints[t]]
        out[t, 8:74] = np.ravel(own)
        if t:
            out[t, :2] = (_about_y(angles[t - 1]) @ (joints[t, 0] - joints[t - 1, 0]))[[0, 2]]
        out[t, 2:8] = _about_y(angle - angles[t - 1] if t else angle)[:2].ravel()
    return out


def encode_296(bent: float = 0.0) -> Floats:
    """Columns [T - 1, 296] of the walk on SnapMoGen's joints, in units of 18 mm, frame by frame."""
    joints, angles = _posed(bent)
    order = (15, 16, 20, 1, 17, 21, 2, 18, 22, 3, 19, 23, 4, 7, 11, 6, 8, 12, 9, 13, 10, 14)
    ours = {theirs: number for number, theirs in enumerate(order)} | {0: 0, 5: 12}
    figure = np.stack([joints[:, ours[number]] for number in range(24)], axis=1) / 0.018
    rows = []
    for t in range(len(figure) - 1):
        turn = _about_y(angles[t])
        step = turn @ (figure[t + 1, 0] - figure[t, 0])
        own = [turn @ (joint - figure[t, 0] * [1, 0, 1]) for joint in figure[t]]
        root = [angles[t + 1] - angles[t], step[0], step[2], own[0][1]]
        rows.append([*root, *np.zeros(144), *np.ravel(own), *np.zeros(76)])
    return np.array(rows)


def motion272(root: Path) -> Path:
    """HumanML3D-272's tree: two clips, a mirrored one, and one that is listed but not there."""
    (root / "motion_data").mkdir(parents=True)
    for name, bent in (("000000", 0.0), ("M000000", 0.3), ("000001", 0.6)):
        np.save(root / f"motion_data/{name}.npy", encode_272(bent))
        put(root / f"texts/{name}.txt", "a person walks#a/DET person/NOUN walk/VERB#0.0#0.0\n")
    put(root / "split/train.txt", "000000\nM000000\n000002\n")
    put(root / "split/test.txt", "000001\n")
    return root


def snapmogen(root: Path) -> Path:
    """A recording of which two parts have captions, and one whose file is not there."""
    (root / "renamed_feats").mkdir(parents=True)
    np.save(root / "renamed_feats/m_ep2_00086.npy", encode_296())
    said = {"manual": ["A person walks."], "gpt": ["Someone walks to the left."]}
    names = ["m_ep2_00086#0#90", "m_ep2_00086#30#80", "gone#0#90"]
    put(root / "all_caption_clean.json", dict.fromkeys(names, said))
    put(root / "data_split_info1/train_ids.txt", "\n".join(names) + "\n")
    return root


def beat2(root: Path) -> Path:
    """A talk with speech and words, and an additional one without."""
    folder = root / "beat_english_v2.0.0"
    (folder / "smplxflame_30").mkdir(parents=True)
    for name, bent in (("2_scott_0_1_1", 0.0), ("2_scott_0_2_2", 0.3)):
        poses, trans = walk(bent)
        flat = np.concatenate([poses[:, :22], np.full((len(poses), 3, 3), 0.1), poses[:, 22:]], axis=1)
        face = np.linspace(-1, 1, len(poses))[:, None] * np.linspace(0.1, 1, 100)
        np.savez(
            folder / f"smplxflame_30/{name}.npz", poses=flat.reshape(-1, 165), trans=trans,
            expressions=face, betas=np.zeros(300), gender="neutral", mocap_frame_rate=30,
        )  # fmt: skip
    put(folder / "train_test_split.csv", "id,type\n2_scott_0_1_1,test\n2_scott_0_2_2,additional\n")
    sing(folder / "wave16k/2_scott_0_1_1.wav")
    words = ((0.0, 0.2, ""), (0.2, 0.6, "hello"), (0.6, 1.0, "there"), (1.0, 2.0, ""), (2.0, 2.5, "friend"))
    rows = [f'xmin = {a} \n xmax = {b} \n text = "{word}" ' for a, b, word in words]
    tier = "\n".join([' class = "IntervalTier" ', ' name = "words" ' + "\n" * 2**20, *rows])
    phones = tier.replace("words", "phones").replace("hello", "HH")
    text = f'File type = "ooTextFile"\nitem []: \n  item [1]:\n{tier}\n  item [2]:\n{phones}\n'
    put(folder / "textgrid/2_scott_0_1_1.TextGrid", text)
    return root


def style100(root: Path) -> Path:
    """Three movements of two styles, of which one has no frames in the list of cuts."""
    for style, movement in (("ArmsAboveHead", "FW"), ("ArmsAboveHead", "ID"), ("Old", "FW")):
        lines = "\n" * (len(style) + len(movement + style) * (movement == "ID"))  # no two are the same
        put(root / f"{style}/{style}_{movement}.bvh", bvh_file("Xsens MVN", 60.0, 40) + lines)
    cuts = ["STYLE_NAME,FW_START,FW_STOP,ID_START,ID_STOP", "ArmsAboveHead,40,221,N/A,N/A", "Old,40,221,,"]
    put(root / "Frame_Cuts.csv", "\n".join(cuts) + "\n")
    styles = ["Style Name,Description", "Arms Above Head,Both arms held up.", "Old,Slow and bent."]
    put(root / "Dataset_List.csv", "\n".join(styles) + "\n")
    return root
