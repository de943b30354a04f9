"""`MotionModel.edit`: a clip of which a part is made anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.register import register
from motionloom.datasets.motion.body.retarget import posed_by
from motionloom.datasets.motion.body.rigid import RigidMotion, at_rate, mirrored
from motionloom.datasets.motion.bvh.own_file import OwnBvh
from motionloom.datasets.motion.canonical import facing, ground, mirror, resample
from motionloom.datasets.motion.kinematics import forward_kinematics
from motionloom.datasets.motion.layout import PIECES, piece_joints
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.models.layers.seeds import sample_seeds
from motionloom.pipeline.contract.ability import Ability
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.editing.finish import finish, own_bvh, own_figure, report_of
from motionloom.pipeline.editing.frames import EditFrames, edit_frames
from motionloom.pipeline.editing.own_file import between_rows
from motionloom.pipeline.editing.task import EditReport, EditTask
from motionloom.pipeline.editing.timed import require_work
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.clip_file import RecordedClip, features_for, read_clip, require_clip
from motionloom.pipeline.inference.files.display_figure import shown
from motionloom.pipeline.inference.generation import encode
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.request import require_samples, require_seed

ABILITY = "edit"
_BLEND = 0.5
"""Seconds in which a clip that comes again passes into its beginning [ours]."""


@dataclass(frozen=True, repr=False)
class EditedMotion(GeneratedMotion):
    """A clip of which a part was made anew, in the clip's world, the floor at height 0."""

    original: GeneratedMotion = field(kw_only=True)
    """The clip, at the model's frame rate."""
    report: EditReport = field(kw_only=True)
    """Errors against its task."""
    remarks: tuple[str, ...] = ()
    """Remarks on how the clip was read."""


def edit(
    model: MotionModel,
    clip: Path | str | GeneratedMotion,
    task: EditTask | Mapping[str, object],
    *,
    samples: int = 1,
    seed: int = 0,
    sampling: SamplingConfig | Mapping[str, object] | None = None,
) -> list[EditedMotion]:
    """As `MotionModel.edit`, which this is."""
    asked = EditTask.parse(task, "task")
    recorded = recorded_of(clip) if isinstance(clip, GeneratedMotion) else read_clip(Path(clip))
    with model.threads(samples):
        return edit_clip(model.bundle, recorded, asked, samples, seed, SamplingConfig.of(sampling))


_WITHOUT = "makes whole motions and edits none; take an in-betweener, such as the package's `inbetween`"
register(Ability(ABILITY, edit, _WITHOUT))


def recorded_of(motion: GeneratedMotion) -> RecordedClip:
    """A generated motion as a clip."""
    figure = shown(motion).figure
    bvh = motion.bvh if isinstance(motion.bvh, OwnBvh) else None
    facts = (motion.fps, motion.face, motion.caption, bvh, figure)
    return require_clip(RecordedClip("the motion", figure.joints, *facts))


def changed(clip: RecordedClip, task: EditTask) -> RecordedClip:
    """The clip mirrored, at another speed and several times in a row, as a task says."""
    joints = clip.joints
    face = clip.face
    pace = clip.fps * task.speed
    posed = clip.posed or clip.figure
    if task.mirror:
        joints = mirror(joints, Skeleton.named("smplx52" if clip.has_hands else "smpl22"))
        posed = posed and mirrored(posed)
    posed = posed and at_rate(posed, pace, clip.fps)
    joints = once = resample(joints, pace, clip.fps)
    blend = np.clip(np.arange(len(once)) / (_BLEND * clip.fps), 0, 1)[:, None, None]
    blend = blend * blend * (3 - 2 * blend)
    turns = [] if posed is None else [_world(posed)]
    for _ in range(task.repeat - 1):
        turn = facing(joints[-1:])[0] - facing(once[:1])[0]
        plane = (ground(once) - ground(once[0, 0])) * np.exp(1j * turn) + ground(joints[-1, 0])
        following = np.stack([plane.imag, once[..., 1], plane.real], axis=-1)
        # The pose in which the clip ended gives way to the one in which it begins.
        following += (joints[-1] - following[0]) * (1 - blend)
        joints = np.concatenate([joints, following[1:]])
        if posed is not None:
            turned = Rotation.from_euler("y", turn).as_matrix() @ turns[0]
            away = Rotation.from_matrix(turned[0].swapaxes(-1, -2) @ turns[-1][-1]).as_rotvec()
            eased = Rotation.from_rotvec(((1 - blend) * away).reshape(-1, 3)).as_matrix()
            turns.append((turned @ eased.reshape(turned.shape))[1:])
    if face is not None:
        face = resample(face, pace, clip.fps)
        face = np.concatenate([face, *[face[1:]] * (task.repeat - 1)])
    if posed is not None and task.repeat > 1:
        known = np.ones(len(posed.skeleton), dtype=np.bool_)
        posed = posed_by(joints, np.concatenate(turns), known, posed.skeleton)
    return replace(clip, joints=joints, face=face, figure=None, posed=posed)


def _world(posed: RigidMotion) -> NDArray[np.float64]:
    """World rotations [T, N, 3, 3]."""
    skeleton = posed.skeleton
    return forward_kinematics(posed.rotations, posed.root, skeleton.offsets, skeleton.parents)[1]


def edit_clip(
    bundle: Bundle, clip: RecordedClip, task: EditTask, samples: int, seed: int, sampling: SamplingConfig
) -> list[EditedMotion]:
    """Edit a clip as `MotionModel.edit`."""
    require_seed(seed)
    require_samples(samples)
    layout = bundle.layout
    generator = bundle.generator
    require_work(task, clip, layout)
    if task.changes_clip:
        before = edit_frames(EditTask(), clip, layout)
        frames = edit_frames(task, changed(clip, task), layout)
    else:
        before = frames = edit_frames(task, clip, layout)
    prompt = Prompt(task.caption)
    original = original_of(before, clip)
    words = encode(bundle, bundle.main, [prompt], [prompt.text]) if prompt.text.strip() else {}
    fill = generator.capabilities.more[ABILITY]
    whole = np.repeat(frames.known.features[None], samples, axis=0)
    drawn = fill(frames.known, words, sample_seeds(seed, samples), bundle.drawing(sampling))
    whole[..., layout.part(generator.part)] = np.stack(drawn)
    # A face that the model does not make is the clip's, if that has one.
    has_face = layout.has("face") and (generator.part == "all" or frames.face is not None)
    out = []
    for made in whole:
        features, figure, heading = finish(frames, made[:, layout.part("bodyhand")])
        face = made[:, layout.part("face")] if has_face else None
        # Words are looked for in each stretch that was made, as in motions that are generated.
        stretches = [
            GeneratedMotion(prompt, features[start:end], figure.joints[start:end], None, layout)
            for start, end in frames.stretches
        ]
        notes = [*map(str, bundle.notes([prompt], stretches))] if words else []
        bvh = None
        fps = layout.fps
        if clip.bvh is not None:
            try:
                bvh = own_bvh(clip.bvh, frames, figure)
            except UserError as error:
                notes.append(f"a BVH of this has a skeleton of ours, not the clip's: {error}")
        elif frames.written.drawn and not task.changes_clip:
            figure = own_figure(clip, frames, figure)
            fps = clip.fps
        # What is said is of the joints that a file holds.
        rounded = figure.joints.astype(np.float32) + np.array([0, frames.written.base, 0])
        rate = fps if bvh is None else bvh.motion.fps
        joints = frames.of_file(rounded if bvh is None else bvh.places(), rate)
        if words:
            notes += _note_on_hands(frames, joints)
        edited = EditedMotion(
            prompt, features, figure.joints, face, layout, seed=seed, original=original, bvh=bvh,
            report=report_of(frames, joints, heading, rate), remarks=(*frames.remarks, *notes),
        )  # fmt: skip
        out.append(_drawn(edited, figure, fps))
    return out


def _note_on_hands(frames: EditFrames, joints: NDArray[np.float64]) -> list[str]:
    """How far the hands moved, where nothing else is made anew: words may ask for more than they can do."""
    clip = frames.written.joints
    if joints.shape != clip.shape or not frames.pieces[:, : PIECES.index("left_hand")].all():
        return []
    made_anew = ~frames.pieces[frames.inside][:, piece_joints(frames.layout)[: joints.shape[1]]]
    if not made_anew.any():
        return []
    away = np.linalg.norm(joints - clip, axis=-1)[made_anew].mean()
    return [f"hands alone are made anew: by {100 * away:.1f} cm on average"]


def original_of(frames: EditFrames, clip: RecordedClip) -> GeneratedMotion:
    """The clip of a task: a figure of ours as it is, others as the model reads them."""
    layout = frames.layout
    figure = frames.world.figure(frames.figure)
    features = frames.known.features[frames.inside][:, layout.part("bodyhand")]
    motion = GeneratedMotion(Prompt(clip.caption), features, figure.joints, frames.face, layout, bvh=clip.bvh)
    if frames.written.drawn and clip.figure is not None and clip.bvh is None:
        return _drawn(motion, clip.figure, clip.fps)
    return _drawn(motion, figure, layout.fps)


Drawn = TypeVar("Drawn", bound=GeneratedMotion)


def _drawn(motion: Drawn, figure: RigidMotion, fps: float) -> Drawn:
    """The motion with the figure that is shown of it, at the frame rate of that."""
    joints = figure.joints
    face = motion.face
    layout = replace(motion.layout, fps=fps)
    if fps == motion.fps:
        return replace(motion, figure=figure, joints=joints)
    if face is not None:
        at = np.arange(len(joints)) / fps * motion.fps
        face = between_rows(face[..., None], at.clip(0, len(face) - 1))[..., 0].astype(np.float32)
    features = features_for(joints, fps, layout.without_face())[0]
    return replace(motion, figure=figure, joints=joints, face=face, features=features, layout=layout)
