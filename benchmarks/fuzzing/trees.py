"""Sources of all converters: a tiny tree of each, whose lists and motion files are damaged one at a time."""

from __future__ import annotations

import json
import pickle
import re
from collections.abc import Callable
from importlib.util import find_spec, module_from_spec
from pathlib import Path

import amass_clips
import numpy as np
from bvh_clips import write_source
from rig_characters import character

from fuzzing.mutations import Mutator, damaged_json, damaged_text
from fuzzing.sealed import damaged_glb, damaged_npy, damaged_pickle, damaged_zip
from fuzzing.sounds import damaged_wav
from fuzzing.table import Read, Seed, of_tree, reader
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.convert.registry import converter_named, names, prepare
from motionloom.datasets.motion.canonical import canonicalize
from motionloom.datasets.shards.sample import DropClip
from motionloom.pipeline.rigs.gltf import Gltf

release_trees = module_from_spec(find_spec("release_trees"))  # a copy of its own, as tests use the module too
release_trees.__spec__.loader.exec_module(release_trees)
release_trees.SECONDS = 1.2  # small files are read often

_DAMAGES: dict[str, Mutator] = {
    ".csv": damaged_text,
    ".txt": damaged_text,
    ".TextGrid": damaged_text,
    ".jsonl": damaged_json,
    ".json": damaged_json,
    ".npy": damaged_npy,
    ".npz": damaged_zip,
    ".pkl": damaged_pickle,
    ".bvh": damaged_text,
    ".asf": damaged_text,
    ".amc": damaged_text,
    ".wav": damaged_wav,
    ".glb": damaged_glb,
}


def _joints(bent: float = 0.0) -> np.ndarray:
    poses, trans = release_trees.walk(bent)
    body = release_trees.BodyModel.neutral("smpl22")
    return canonicalize(release_trees.smpl_joints(poses[:, :22], trans, body))


def humanml3d(root: Path) -> Path:
    """Joints of three clips, one mirrored, with texts and split files."""
    (root / "new_joints").mkdir(parents=True)
    for name, bent in (("000001", 0.0), ("M000001", 0.2), ("000002", 0.5)):
        np.save(root / f"new_joints/{name}.npy", _joints(bent).astype(np.float32))
        release_trees.put(
            root / f"texts/{name}.txt",
            "a person walks#a/DET person/NOUN walk/VERB#0.0#0.0\nsomeone goes#someone/PRON go/VERB#0.2#0.9\n",
        )
    release_trees.put(root / "train.txt", "000001\nM000001\n")
    release_trees.put(root / "test.txt", "000002\n")
    return root


def motionx(root: Path) -> Path:
    """Two clips of two subsets with both grammars of captions, and a face."""
    for name, text in (
        ("GRAB/s1/mug_1", "a person lifts a mug\n"),
        ("humanml/000001", "a person walks#a/DET person/NOUN walk/VERB#0.0#0.0\n"),
    ):
        poses, trans = release_trees.walk(0.1)
        values = np.zeros((len(poses), 322))
        values[:, :66] = poses[:, :22].reshape(len(poses), -1)
        values[:, 66:156] = poses[:, 22:].reshape(len(poses), -1)
        values[:, 309:312] = trans
        path = root / f"motion_data/smplx_322/{name}.npy"
        path.parent.mkdir(parents=True)
        np.save(path, values.astype(np.float32))
        release_trees.put(root / f"texts/semantic_labels/{name}.txt", text)
    release_trees.put(root / "train.txt", "GRAB/s1/mug_1\n")
    release_trees.put(root / "test.txt", "humanml/000001\n")
    return root


def aistpp(root: Path) -> Path:
    """Two dances, one of which is ignored, with the crossmodal splits and one song."""
    poses, trans = release_trees.walk()
    flat = np.concatenate([poses[:, :22], np.zeros((len(poses), 2, 3))], axis=1).reshape(len(poses), 72)
    data = {
        "smpl_loss": 0.0,
        "smpl_poses": flat.astype(np.float32),
        "smpl_scaling": np.array([90.0], np.float32),
        "smpl_trans": (90 * trans).astype(np.float32),
    }
    (root / "motions").mkdir(parents=True)
    for number in (1, 8):
        name = f"gBR_sBM_cAll_d04_mBR0_ch0{number}"
        (root / f"motions/{name}.pkl").write_bytes(pickle.dumps(data, protocol=2))
    release_trees.put(
        root / "splits/crossmodal_train.txt", "gBR_sBM_cAll_d04_mBR0_ch01\ngBR_sBM_cAll_d04_mBR0_ch08\n"
    )
    release_trees.put(root / "ignore_list.txt", "gBR_sBM_cAll_d04_mBR0_ch08\n")
    return root


def amass(root: Path) -> Path:
    """A clip of SMPL-H and one of SMPL-X in parts."""
    amass_clips.save(root / "CMU/01/01_01_poses.npz", **amass_clips.walk(30.0, 1.2))
    parts = amass_clips.in_parts(amass_clips.walk(60.0, 1.2))
    amass_clips.save(root / "SSM/a_stageii.npz", **parts)
    release_trees.put(root / "captions.csv", "id,caption,start,end\nCMU/01/01_01,a person walks,0,1\n")
    return root


def beat2(root: Path) -> Path:
    """The tests' tree, without the million empty lines in its transcript."""
    for path in release_trees.beat2(root).rglob("*.TextGrid"):
        path.write_text(re.sub("\n+", "\n", path.read_text()))
    return root


def bvh(root: Path) -> Path:
    """Three clips with a joint map, captions in two forms and split files; and a pair of Acclaim files."""
    write_source(root, ("a", "s1/b", "s1/c"))
    release_trees.put(
        root / "captions.json", [{"id": "a", "captions": [{"text": "walks", "start": 0, "end": 1}]}]
    )
    release_trees.put(root / "lists/train.txt", "a\n")
    release_trees.put(root / "lists/test.txt", "s1/b\n")
    asf, amc = acclaim()
    release_trees.put(root / "acclaim/01.asf", asf)
    release_trees.put(root / "acclaim/01_01.amc", amc)
    return root


def acclaim(frames: int = 24) -> tuple[str, str]:
    """A skeleton of a person in CMU's form, and a motion of it."""
    bones = [
        ("lhipjoint", "root", (1, -1, 0), 2),
        ("lfemur", "lhipjoint", (0, -1, 0), 7),
        ("ltibia", "lfemur", (0, -1, 0), 7),
        ("lfoot", "ltibia", (0, -0.2, 1), 2),
        ("ltoes", "lfoot", (0, 0, 1), 1),
        ("rhipjoint", "root", (-1, -1, 0), 2),
        ("rfemur", "rhipjoint", (0, -1, 0), 7),
        ("rtibia", "rfemur", (0, -1, 0), 7),
        ("rfoot", "rtibia", (0, -0.2, 1), 2),
        ("rtoes", "rfoot", (0, 0, 1), 1),
        ("lowerback", "root", (0, 1, 0), 2),
        ("upperback", "lowerback", (0, 1, 0), 2),
        ("thorax", "upperback", (0, 1, 0), 2),
        ("lowerneck", "thorax", (0, 1, 0), 1.7),
        ("upperneck", "lowerneck", (0, 1, 0), 1.7),
        ("head", "upperneck", (0, 1, 0), 1.7),
        ("lclavicle", "thorax", (1, 0.3, 0), 3),
        ("lhumerus", "lclavicle", (1, 0, 0), 5),
        ("lradius", "lhumerus", (1, 0, 0), 3),
        ("lwrist", "lradius", (1, 0, 0), 1.7),
        ("lhand", "lwrist", (1, 0, 0), 0.7),
        ("rclavicle", "thorax", (-1, 0.3, 0), 3),
        ("rhumerus", "rclavicle", (-1, 0, 0), 5),
        ("rradius", "rhumerus", (-1, 0, 0), 3),
        ("rwrist", "rradius", (-1, 0, 0), 1.7),
        ("rhand", "rwrist", (-1, 0, 0), 0.7),
    ]
    lines = [
        ":version 1.10",
        ":name VICON",
        ":units",
        "  mass 1.0",
        "  length 0.45",
        "  angle deg",
        ":root",
        "   order TX TY TZ RX RY RZ",
        "   axis XYZ",
        "   position 0 0 0",
        "   orientation 0 0 0",
        ":bonedata",
    ]
    for number, (name, _, way, length) in enumerate(bones, 1):
        freedom = (
            ""
            if name.endswith(("hipjoint", "clavicle"))
            else "    dof rx ry rz\n    limits (-160.0 20.0)\n     (-70.0 70.0)\n     (-60.0 70.0)\n"
        )
        lines.append(
            f"  begin\n    id {number}\n    name {name}\n    direction {way[0]} {way[1]} {way[2]}\n"
            f"    length {length}\n"
            f"    axis 0 0 20  XYZ\n{freedom}  end"
        )
    lines += [":hierarchy", "  begin", *(f"    {parent} {name}" for name, parent, _, _ in bones), "  end"]
    out = [":FULLY-SPECIFIED", ":DEGREES"]
    for frame in range(frames):
        out += [str(frame + 1), f"root {frame * 0.1} 17 0 0 {frame} 0"]
        out += [
            f"{name} {np.sin(frame / 4) * 20:.4f} 0 0"
            for name, *_ in bones
            if not name.endswith(("hipjoint", "clavicle"))
        ]
    return "\n".join(lines) + "\n", "\n".join(out) + "\n"


def glb(root: Path) -> Path:
    """A character of which one animation turns the hips, and moves them."""
    root.mkdir()
    nodes = character(root / "turn.glb", "unreal")
    rig = Gltf.read(root / "turn.glb")
    angles = np.linspace(0, 1, 31)
    turns = np.stack([0 * angles, np.sin(angles), 0 * angles, np.cos(angles)], axis=1)
    moved = np.stack([angles, 1 + 0 * angles, 0 * angles], axis=1)
    rig.animate(
        "turns about", 20.0, {(nodes["pelvis"], "rotation"): turns, (nodes["pelvis"], "translation"): moved}
    )
    rig.write(root / "turn.glb")
    return root


TREES: dict[str, tuple[Callable[[Path], Path], dict[str, object]]] = {
    "aistpp": (aistpp, {"sound": "none"}),
    "amass": (amass, {"captions": ("captions.csv",), "uncaptioned": "keep"}),
    "beat2": (beat2, {}),
    "bones_seed": (release_trees.bones_seed, {}),
    "bvh": (
        bvh,
        {"captions": ("captions.json",), "splits": "lists", "uncaptioned": "keep", "licence": "CC0-1.0"},
    ),
    "finedance": (release_trees.finedance, {"caption_genre": True}),
    "glb": (glb, {"licence": "CC0-1.0"}),
    "humanml3d": (humanml3d, {}),
    "motion272": (release_trees.motion272, {}),
    "motionhub": (release_trees.motionhub, {}),
    "motionx": (motionx, {}),
    "snapmogen": (release_trees.snapmogen, {}),
    "style100": (release_trees.style100, {}),
}
"""By the converter's name: what makes its source, and its options; places in these are of the source."""

_RAISED = re.compile(r"[A-Za-z_.]*(Error|Exception|Warning|Interrupt|Exit): ")
"""The reason of a file that failed with anything but a `UserError` begins so."""


def source_of(name: str, folder: Path) -> tuple[list[Seed], Read]:
    """Seeds of a converter: each file of its source; read by the plan, and by converting its clip."""
    make, options = TREES[name]
    tree = make(folder / name)
    kind = converter_named(name)
    placed = {
        key: tuple(tree / one for one in value)
        if isinstance(value, tuple)
        else tree / value
        if key == "splits"
        else value
        for key, value in options.items()
    }

    def read(file: str) -> object:
        # A new config each time: some keep what they have read of the lists.
        config = kind.config_class.parse({"source": tree, "look": 0, **placed}, "options")
        conversion = prepare(config, kind=kind)
        for gone in conversion.plan.left_out():
            if _RAISED.match(gone.reason):
                raise AssertionError(f"not a sentence: {gone.reason}")
        is_motion = file.endswith((".npy", ".npz", ".pkl", ".bvh", ".amc", ".asf", ".wav", ".glb"))
        stem = file.rsplit("/", 1)[-1].split(".")[0]
        wanted = [clip for _, clip in conversion.plan.items if is_motion and stem in clip.label()]
        for clip in wanted[:1]:
            try:
                conversion.converter.convert(clip)
            except DropClip:
                pass
            except UserError:
                raise
        return len(conversion.plan.items)

    # Lists say most, and are the cheapest: their files come as often as motion.
    return of_tree(tree, _DAMAGES, read)


for _name in names():
    if _name in TREES:
        reader(
            f"convert {_name}",
            f"sets/{_name}.py",
            f"{_name}/convert.py",
            f"{_name}/files.py",
            "common/release.py",
        )(lambda folder, name=_name: source_of(name, folder))

CAPTION_FILES = {
    "captions.csv": "id,caption,start,end,split\na,a person walks,0,1.5,train\n"
    'b,"walks, and turns",,,test\nb,runs,,,\n',
    "captions.tsv": "file\ttext\na.bvh\ta person walks\nb.bvh\tsomeone turns\n",
    "captions.jsonl": '{"id": "a", "captions": ["walks", {"text": "turns", "start": 0.5, "end": 2}]}\n'
    '{"file": "s/b.bvh", "text": "runs", "split": "test", "start": 0, "end": 3}\n',
    "list.json": json.dumps(
        [{"name": "a", "description": "walks"}, {"name": "b", "captions": ["x", "y"], "split": "val"}]
    ),
    "named.json": json.dumps(
        {
            "a": "walks",
            "b": ["walks", "runs"],
            "c": [{"text": "walks", "start": 0, "end": 1}],
            "00001": {"path": "KIT/3/kick_01_poses", "annotations": [{"text": "kicks"}]},
        }
    ),
    "kit/a.txt": "a person walks\nsomeone goes\n",
    "humanml/000001.txt": "a person walks#a/DET person/NOUN walk/VERB#0.0#0.0\ngoes#go/VERB#1.0#2.5\n",
}
"""Captions in all their forms."""
