"""Read a clip from one file: BVH and AMC of any human skeleton, SMPL parameters as AMASS has them (npz), the
npz and GLB files that are written here, and what a `ClipReader` reads.
"""

from __future__ import annotations

from codecs import BOM_UTF8
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import number, parse_json
from motionloom.datasets.base.records import FACE, HANDS
from motionloom.datasets.base.register import Table, discover, register
from motionloom.datasets.convert.bvh.joint_guess import guess_joint_map
from motionloom.datasets.convert.bvh.read import read_file, read_motion
from motionloom.datasets.convert.bvh.settle import added_frames, settled
from motionloom.datasets.convert.common.features import features_of, require_human, upright
from motionloom.datasets.convert.smpl.smpl_npz import read_motion as read_smpl
from motionloom.datasets.convert.smpl.smpl_npz import read_motion_header
from motionloom.datasets.motion.body.resting_hands import with_resting_hands
from motionloom.datasets.motion.body.retarget import carried
from motionloom.datasets.motion.body.rigid import RigidMotion, with_offsets
from motionloom.datasets.motion.body.smpl import BodyModel
from motionloom.datasets.motion.bvh.joint_map import JointMap, Unit, Up, metres
from motionloom.datasets.motion.bvh.motion import BvhMotion, read_bvh
from motionloom.datasets.motion.bvh.own_file import OwnBvh
from motionloom.datasets.motion.bvh.text import load_text
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.layout import BODY_JOINTS, FACE_DIMS, MotionLayout
from motionloom.datasets.motion.npz import NpzFile
from motionloom.datasets.motion.skeleton import Skeleton

_FIGURE = ("rotations", "offsets", "root")
_SAME_MM = 0.1
"""Millimetres within which an npz's joints are those of its figure: both are rounded to float32."""
_SQUARE = 1e-3
"""By how much a rotation times its transpose may miss the identity."""
Floats = NDArray[np.float64]
LEAST_FRAMES = 4
"""Fewer have no motion in them."""


@dataclass(frozen=True)
class RecordedClip:
    """A clip as it was recorded or made."""

    name: str
    joints: NDArray[np.float64]
    """Metres, Y up: [T, 22, 3], or [T, 52, 3] where it has hands."""
    fps: float
    face: NDArray[np.float32] | None = None
    """Expression [T, 50]."""
    caption: str = ""
    bvh: OwnBvh | None = None
    """The file, where it is a BVH."""
    figure: RigidMotion | None = None
    """The figure whose joints these are, where a file of ours holds it."""
    posed: RigidMotion | None = None
    """Another file's figure with its rotations, on our joints; these are millimetres from `joints`."""

    @property
    def has_hands(self) -> bool:
        return int(self.joints.shape[1]) > BODY_JOINTS

    @property
    def seconds(self) -> float:
        return len(self.joints) / self.fps


@dataclass(frozen=True)
class ClipReader:
    """Reads the files of one ending as clips."""

    name: str
    """The ending."""
    read: Callable[[Path], RecordedClip]
    """`UserError` for what is no clip."""


CLIP_READERS: Table[ClipReader] = Table(ClipReader, "reader of clips")


def read_clip(path: Path) -> RecordedClip:
    """The clip of a file. `UserError` for what is no clip of a person, or too short."""
    discover()
    ending = path.suffix.lower()
    if ending not in CLIP_READERS:
        raise UserError(f"{path}: a clip is a file that ends in {', '.join(CLIP_READERS)}")
    if not path.is_file() and not path.parent.is_file():  # a clip may be one of several in a file
        raise UserError(f"{path}: no such file")
    return require_clip(CLIP_READERS[ending].read(path))


def require_clip(clip: RecordedClip) -> RecordedClip:
    """The clip, if it is a person's and long enough."""
    if len(clip.joints) < LEAST_FRAMES:
        raise UserError(
            f"{clip.name}: {len(clip.joints)} frames are no motion; give a clip of {LEAST_FRAMES} or more"
        )
    try:
        require_human(clip.joints, clip.fps)
    except UserError as error:
        raise UserError(f"{clip.name}: {error}") from None
    return clip


def read_seed_motion(path: Path, layout: MotionLayout) -> NDArray[np.float32]:
    """The layout's columns [T, D] of a clip that `read_clip` reads, at the layout's frame rate, for a
    generator with `seed_frames`. Hands that the clip does not have are at rest, and so is its face.
    """
    clip = read_clip(path)
    if layout.family == "raw":
        raise UserError(
            f"{path}: a clip has joints, and this model goes on from the rotations of layout {layout.name}; "
            f"leave the seed motion out, or give columns [T, {layout.dim}] in Python"
        )
    return features_for(clip.joints, clip.fps, layout, clip.face)[0]


def features_for(
    joints: NDArray[np.floating], fps: float, layout: MotionLayout, face: NDArray[np.floating] | None = None
) -> tuple[NDArray[np.float32], int]:
    """Features [T', D] of joints [T, 22 or 52, 3], and what they hold; hands at rest where there are none."""
    has_hands = joints.shape[1] >= layout.num_joints > BODY_JOINTS
    if joints.shape[1] < layout.num_joints:
        joints = with_resting_hands(joints)
    has_face = face is not None and layout.has("face")
    present = HANDS * has_hands | FACE * has_face
    joints = joints[:, : layout.num_joints]
    return features_of(joints, fps, layout, face=face if has_face else None), present


def _read_bvh(path: Path) -> RecordedClip:
    """The joints that are known by their names; hands only where all fingers are found."""
    data, name = load_text(path, None)
    raw = path.read_bytes()
    mark = BOM_UTF8 if raw.startswith(BOM_UTF8) else b""
    ends = next((end for end in (b"\r\n", b"\r") if end in raw), b"\n")
    motion = read_bvh(data, name=name)
    clip, joint_map, unit, up, added = _mapped(path, motion)
    own = OwnBvh(data, motion, joint_map, metres(joint_map.unit or unit), up, added, mark, ends)
    return replace(clip, bvh=own)


def _read_amc(path: Path) -> RecordedClip:
    return _mapped(path, read_motion(read_file(path, str(path)), str(path)))[0]


def _mapped(path: Path, motion: BvhMotion) -> tuple[RecordedClip, JointMap, Unit, Up, int]:
    """The clip of a motion whose joints have known names, how they are read, and the added frames."""
    guesses = [guess_joint_map(motion, Skeleton.named(name)) for name in ("smplx52", "smpl22")]
    joint_map = next((one for one in guesses if not one.open_rows), None)
    if joint_map is None:
        raise UserError(
            f"{path}: not a skeleton that is known (no joint for {guesses[1].doubts()}); convert it with a "
            f"joint map of its own: motionloom data convert bvh --set joint_map=FILE"
        )
    unit, up, _ = settled(joint_map, [motion])
    added = added_frames(joint_map.apply(motion, unit=unit, up=up))
    source = joint_map.figure(replace(motion, values=motion.values[added:]), unit=unit, up=up)
    clip = RecordedClip(str(path), source.joints, motion.fps, posed=carried(source, joint_map.target))
    return clip, joint_map, unit, up, added


def _read_glb(path: Path) -> RecordedClip:
    from motionloom.pipeline.render.body.glb import read_glb

    try:
        figure, fps, name = read_glb(path)
    except UserError:
        if ".vrm" not in CLIP_READERS:
            raise
        return CLIP_READERS[".vrm"].read(path)  # any character's file
    return RecordedClip(str(path), figure.joints, fps, None, name, figure=figure)


def _read_npz(path: Path) -> RecordedClip:
    with NpzFile(path) as stored:
        if "joints" not in stored.names and {"poses", "pose_body"} & stored.names:
            return _read_smpl(path)
        joints = stored.numbers("joints")
        face = stored.numbers("face").astype(np.float32) if "face" in stored.names else None
        posed = [stored.numbers(name) for name in _FIGURE if name in stored.names]
        text = str(stored.array("metadata")) if "metadata" in stored.names else "{}"
    facts = parse_json(text, f"{path}: its metadata")
    if joints.ndim != 3 or joints.shape[1] not in (BODY_JOINTS, 52) or joints.shape[2] != 3:
        raise UserError(f"{path}: joints of shape {list(joints.shape)}, wanted [T, 22 or 52, 3]")
    if face is not None and face.shape != (len(joints), FACE_DIMS):
        raise UserError(f"{path}: a face of shape {list(face.shape)}, wanted [{len(joints)}, {FACE_DIMS}]")
    facts = facts if isinstance(facts, dict) else {}
    fps = number(facts.get("fps"), f"{path}: its metadata: fps", 1000, 0.1)
    figure = _figure_of(joints, *posed) if len(posed) == len(_FIGURE) else None
    return RecordedClip(str(path), joints, fps, face, str(facts.get("caption", "")), figure=figure)


def _read_smpl(path: Path) -> RecordedClip:
    """Parameters of SMPL, Z up, on the neutral body."""
    header = read_motion_header(path, str(path))
    if header.fps is None:
        raise UserError(f"{path}: no mocap_frame_rate, so its frame rate is not known")
    given = read_smpl(path, str(path), hands=header.hands)
    body = BodyModel.neutral("smplx52" if header.hands else "smpl22")
    assert given.rotations is not None and given.trans is not None  # a motion of parameters has both
    vectors, trans = upright(given.rotations, given.trans, body)
    local = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)
    root = body.rest_joints()[0] + trans
    skeleton = body.skeleton
    joints, _ = forward_kinematics(local, root, skeleton.offsets, skeleton.parents)
    figure = RigidMotion.posed(skeleton, local, root, joints)
    return RecordedClip(str(path), joints, header.fps, figure=figure)


def _figure_of(joints: Floats, rotations: Floats, offsets: Floats, root: Floats) -> RigidMotion | None:
    """The figure of an npz, if it is the one whose joints these are."""
    skeleton = Skeleton.named("smpl22" if joints.shape[1] == BODY_JOINTS else "smplx52")
    shapes = ((*joints.shape, 3), joints.shape[1:], (len(joints), 3))
    if (rotations.shape, offsets.shape, root.shape) != shapes:
        return None
    turned = rotations @ np.swapaxes(rotations, -1, -2)
    if not (np.abs(turned - np.eye(3)) < _SQUARE).all() or not (np.linalg.det(rotations) > 0).all():
        return None  # those of a last joint turn nothing, and so may be anything
    figure = RigidMotion.posed(with_offsets(skeleton, offsets), rotations, root, joints)
    return replace(figure, joints=joints) if figure.error.max_mm < _SAME_MM else None


for _ending, _read in {".bvh": _read_bvh, ".amc": _read_amc, ".npz": _read_npz, ".glb": _read_glb}.items():
    register(ClipReader(_ending, _read))
