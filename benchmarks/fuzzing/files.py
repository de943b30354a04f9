"""Readers of files of motion and of sound, and of the forms in which captions come."""

from __future__ import annotations

import json
import pickle
import struct
from functools import cache
from pathlib import Path

import amass_clips
import numpy as np
import soundfile
from bvh_clips import write_clip

from fuzzing import trees
from fuzzing.mutations import damaged_json, damaged_text
from fuzzing.sealed import damaged_glb, damaged_npy, damaged_pickle, damaged_zip
from fuzzing.sounds import damaged_flac, damaged_mp3, damaged_ogg, damaged_wav
from fuzzing.table import Read, Seed, of_files, of_tree, reader
from motionloom.datasets.audio.given_beats import with_beats
from motionloom.datasets.audio.sound import Sound, sound_seconds
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.convert.aistpp.pickle_reader import read_aist_motion
from motionloom.datasets.convert.captions.collect import Captions
from motionloom.datasets.convert.captions.humanml_index import read_index
from motionloom.datasets.convert.common.arrays import load_array
from motionloom.datasets.convert.common.splits import keep_mirrors_together, read_split_files
from motionloom.datasets.convert.smpl.smpl_npz import read_motion, read_motion_header
from motionloom.datasets.motion.body.smpl import BodyModel
from motionloom.datasets.motion.bvh.asf import read_amc
from motionloom.datasets.motion.bvh.joint_map import JointMap
from motionloom.datasets.motion.bvh.motion import read_bvh
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.evaluation.reconstruction import expression_directions
from motionloom.pipeline.inference.clip_file import read_clip
from motionloom.pipeline.inference.files.outputs import save
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.render.body.face import ARKIT, ArkitBases
from motionloom.pipeline.rigs.rig import Rig
from motionloom.pipeline.songs.songs import AnnotatedSong

Made = tuple[list[Seed], Read]

# Motion.


@cache
def walked(frames: int = 24) -> np.ndarray:
    """Joints [T, 52, 3] of somebody who walks."""
    poses, trans = trees.release_trees.walk()
    body = BodyModel.neutral("smplx52")
    joints = trees.canonicalize(trees.release_trees.smpl_joints(poses, trans, body))
    return np.asarray(
        np.resize(joints, (max(frames, 4), 52, 3)) if len(joints) < frames else joints[:frames]
    ).copy()


def _made() -> GeneratedMotion:
    layout = MotionLayout.named("wholebody363", fps=20.0)
    joints = walked()
    face = np.zeros((len(joints), 50), np.float32)
    return GeneratedMotion(
        Prompt("a person walks"), np.zeros((len(joints), 313), np.float32), joints, face, layout, seed=1
    )


@cache
def npz_clip(folder: Path) -> bytes:
    """A clip as we write it."""
    save(folder / "made.npz", _made())
    return (folder / "made.npz").read_bytes()


@cache
def glb_clip(folder: Path) -> bytes:
    """An animation as we write it, without the body's surface, which nobody reads and is most of it."""
    layout = MotionLayout.named("body133", fps=20.0)
    joints = walked()[:, :22]
    features = np.zeros((len(joints), layout.dim), np.float32)
    save(folder / "made.glb", GeneratedMotion(Prompt("walks"), features, joints, None, layout, seed=1))
    raw = (folder / "made.glb").read_bytes()
    end = 20 + int.from_bytes(raw[12:16], "little")
    scene = json.loads(raw[20:end])
    blob = raw[end + 8 :]
    kept = b""
    scene["meshes"] = scene["materials"] = []
    used = {
        place
        for one in scene["animations"]
        for sampler in one["samplers"]
        for place in (sampler["input"], sampler["output"])
    }
    for place, accessor in enumerate(scene["accessors"]):
        view = scene["bufferViews"][accessor["bufferView"]]
        if place in used:
            begin = view.get("byteOffset", 0)
            view["byteOffset"], kept = len(kept), kept + blob[begin : begin + view["byteLength"]]
        else:
            view |= {"byteOffset": 0, "byteLength": 0}
    scene["accessors"] = [
        one if place in used else {**one, "count": 0} for place, one in enumerate(scene["accessors"])
    ]
    scene["nodes"] = [
        {key: value for key, value in node.items() if key not in ("mesh", "skin")} for node in scene["nodes"]
    ]
    text = json.dumps(scene, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(kept), b"BIN\0") + kept
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


@cache
def bvh_clip(folder: Path, frames: int = 12) -> bytes:
    """A short BVH."""
    return write_clip(folder / "made.bvh", 1, frames=frames).read_bytes()


@reader("bvh", "bvh/text.py", "bvh/read.py")
def _bvh(folder: Path) -> Made:
    foreign = trees.release_trees.bvh_file("Xsens MVN", 10.0).encode()
    seeds, read = of_files(folder, "a.bvh", [bvh_clip(folder), foreign], damaged_text, read_bvh)
    return seeds, lambda seed, content: read(seed, content).positions()  # type: ignore[attr-defined]


@reader("clip bvh", "clip_file.py")
def _clip_bvh(folder: Path) -> Made:
    return of_files(folder, "a.bvh", [bvh_clip(folder)], damaged_text, read_clip)


@reader("clip npz")
def _clip_npz(folder: Path) -> Made:
    return of_files(folder, "a.npz", [npz_clip(folder)], damaged_zip, read_clip)


@reader("clip glb", "body/glb.py")
def _clip_glb(folder: Path) -> Made:
    return of_files(folder, "a.glb", [glb_clip(folder)], damaged_glb, read_clip)


@reader("asf and amc")
def _acclaim(folder: Path) -> Made:
    asf, amc = (text.encode() for text in trees.acclaim(6))

    def read(seed: Seed, content: bytes) -> object:
        parts = (content, amc) if seed.file.endswith("asf") else (asf, content)
        return read_amc(*parts, name="a.amc").positions()

    return [Seed("a.asf", asf, damaged_text), Seed("a.amc", amc, damaged_text)], read


@reader("joint map", "joint_map.py")
def _joint_map(folder: Path) -> Made:
    rows = [[number, name, name] for number, name in enumerate(Skeleton.named("smpl22").joints)]
    whole = {"smpl22": rows, "unmapped": [], "unit": "cm", "up": "y"}
    return of_files(folder, "map.json", [json.dumps(whole).encode()], damaged_json, JointMap.load)


@reader("aist pickle", "pickle_reader.py")
def _aist(folder: Path) -> Made:
    data = {
        "smpl_loss": 0.5,
        "smpl_poses": np.zeros((12, 72), np.float32),
        "smpl_scaling": np.array([90.0], np.float32),
        "smpl_trans": np.ones((12, 3), np.float32),
    }
    contents = [pickle.dumps(data, protocol=protocol) for protocol in range(6)]
    return of_files(folder, "a.pkl", contents, damaged_pickle, read_aist_motion)


@reader("amass npz", "motion/npz.py", "smpl_npz.py")
def _amass(folder: Path) -> Made:
    clip = amass_clips.walk(30.0, 0.4)
    forms = (clip, amass_clips.as_smplx(clip), amass_clips.in_parts(clip))
    contents = [amass_clips.save(folder / "a.npz", **form).read_bytes() for form in forms]

    def read(path: Path) -> object:
        header = read_motion_header(path, path.name)
        return read_motion(path, path.name, hands=header.hands)

    return of_files(folder, "a.npz", contents, damaged_zip, read)


@reader("body model", "body/smpl.py")
def _body(folder: Path) -> Made:
    path = amass_clips.body_model(folder / "model.npz", 52, 1.0)
    return of_files(
        folder, "model.npz", [path.read_bytes()], damaged_zip, lambda path: BodyModel.load(path, "smpl22")
    )


@reader("face bases", "body/face.py")
def _face(folder: Path) -> Made:
    random = np.random.default_rng(0)
    np.savez(
        folder / "a.npz", source=random.normal(size=(5, 60, 3)), arkit=random.normal(size=(len(ARKIT), 60, 3))
    )
    return of_files(
        folder,
        "a.npz",
        [(folder / "a.npz").read_bytes()],
        damaged_zip,
        lambda path: ArkitBases.read(path).weights(np.zeros((2, 5))),
    )


@reader("face of a body model", "evaluation/reconstruction.py")
def _expressions(folder: Path) -> Made:
    np.savez(folder / "a.npz", shapedirs=np.random.default_rng(0).normal(size=(6, 3, 350)))
    return of_files(folder, "a.npz", [(folder / "a.npz").read_bytes()], damaged_zip, expression_directions)


@reader("character", "rigs/gltf.py", "rigs/names.py")
def _character(folder: Path) -> Made:
    tree = trees.glb(folder / "tree")
    rig = Rig.read(tree / "turn.glb")
    names = {joint: rig.gltf.names()[node] for joint, node in rig.nodes.items()}
    (tree / "map.json").write_text(json.dumps(names))

    def read(file: str) -> object:
        return Rig.read(tree / "turn.glb", tree / "map.json" if file.endswith("json") else None)

    return of_tree(tree, {".glb": damaged_glb, ".json": damaged_json}, read)


@reader("song with beats", "songs/songs.py")
def _song(folder: Path) -> Made:
    AnnotatedSong(np.zeros((2, 90, 64), np.float16), np.array([0.2, 0.7]), np.array([True, False])).save(
        folder / "song.npz"
    )
    return of_files(folder, "song.npz", [(folder / "song.npz").read_bytes()], damaged_zip, AnnotatedSong.load)


@reader("vectors npy", "common/arrays.py")
def _vectors(folder: Path) -> Made:
    contents = []
    for values in (
        np.zeros((8, 263), np.float32),
        np.ones((8, 22, 3)),
        np.ones((4, 263), ">f4"),
        np.ones((8, 263), order="F"),
    ):
        np.save(folder / "a.npy", values)
        contents.append((folder / "a.npy").read_bytes())

    def read(path: Path) -> object:
        rank = 3 if b"22, 3" in path.read_bytes()[:128] else 2
        return load_array(path, width=263 if rank == 2 else (22, 3))

    return of_files(folder, "a.npy", contents, damaged_npy, read)


# Sound.


@cache
def sound(folder: Path, ending: str) -> bytes:
    """A second of tones with a pause, in one of the formats."""
    times = np.arange(16_000) / 16_000
    wave = 0.4 * np.sin(2 * np.pi * 220 * times) * (times < 0.8) + 0.02 * np.sin(2 * np.pi * 3000 * times)
    samples = np.stack([wave, wave[::-1]], axis=1) if ending == "ogg" else wave
    soundfile.write(folder / f"a.{ending}", samples.astype(np.float32), 16_000)
    return (folder / f"a.{ending}").read_bytes()


def _heard(path: Path) -> object:
    if sound_seconds(path) > 120:  # rate and length may be damaged so that they are right together
        return None
    return Sound.read(path, rate=8000 if path.stat().st_size % 3 == 0 else None)


for _ending, _damage in (
    ("wav", damaged_wav),
    ("flac", damaged_flac),
    ("ogg", damaged_ogg),
    ("mp3", damaged_mp3),
):
    reader(f"sound {_ending}", "audio/sound.py")(
        lambda folder, ending=_ending, damage=_damage: of_files(
            folder, f"a.{ending}", [sound(folder, ending)], damage, _heard
        )
    )


@reader("sound part")
def _part(folder: Path) -> Made:
    sound(folder, "wav")
    names = [f"{folder}/a.wav@{part}" for part in ("0:00-0:01", "0.2-0.9", "-0:01", "0.1-", "0:00:00-1")]
    seeds = [Seed("name", name.encode(), damaged_text) for name in names]
    return seeds, lambda _, content: Sound.read(content.decode("utf-8", "replace"))


@reader("given beats", "given_beats.py")
def _given_beats(folder: Path) -> Made:
    heard = Sound(np.zeros(48000, np.float32), 16000)
    contents = [b"0.1, 0.6, 1.1", b"[0.1, 0.6, 1.1]", b'{"beats": [0.1, 0.6]}', b"120@0.2", b"300@0.1"]
    seeds = [Seed("beats", content, damaged_text) for content in contents]
    return seeds, lambda _, content: with_beats(heard, content.decode("utf-8", "replace"))


# Captions and lists.


@reader(
    "captions",
    "base/config.py",
    "base/json_doors.py",
    "base/records.py",
    "captions/read.py",
    "captions/options.py",
    "humanml_text.py",
    "common/tables.py",
    "common/files.py",
)
def _captions(folder: Path) -> Made:
    damages = {
        "csv": damaged_text,
        "tsv": damaged_text,
        "jsonl": damaged_json,
        "json": damaged_json,
        "txt": damaged_text,
    }

    def read(seed: Seed, content: bytes) -> object:
        path = folder / seed.file
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        return Captions.read([path.parent if path.suffix == ".txt" else path])

    seeds = [
        Seed(name, text.encode(), damages[name.rpartition(".")[2]])
        for name, text in trees.CAPTION_FILES.items()
    ]
    return seeds, read


@reader("humanml index", "humanml_index.py")
def _index(folder: Path) -> Made:
    text = (
        "source_path,start_frame,end_frame,new_name\n./pose_data/KIT/3/kick_high_left02_poses.npy,0,117,000000.npy\n"
        "./pose_data/CMU/01/01_01_poses.npy,10,-1,000001.npy\n"
    )

    def read(path: Path) -> object:
        bad: dict[str, str] = {}
        rows = read_index(path, bad)
        if not rows and bad:
            raise UserError(next(iter(bad.values())))
        return rows

    return of_files(folder, "index.csv", [text.encode()], damaged_text, read)


@reader("split files", "common/splits.py", "sets/bvh_sets.py", "rigs/convert.py")
def _splits(folder: Path) -> Made:
    tree = folder / "lists"
    tree.mkdir()
    for name, ids in (
        ("train", "000001\nM000001\ns/a\n"),
        ("val", "000003.npy\n"),
        ("test", "000002\r\n\r\nM000002\r\n"),
    ):
        (tree / f"{name}.txt").write_bytes(ids.encode())

    def read(_: str) -> object:
        lists = read_split_files(tree)
        keep_mirrors_together(lists.splits, tree)
        return lists

    return of_tree(tree, {".txt": damaged_text}, read)
