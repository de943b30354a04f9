"""HumanML3D -> shards: the published 263-column vectors as they are, or features made from the joints.

Choices:
- The published folders hold the same motion twice: new_joints/ is new_joint_vecs/ decoded (both have one
  frame less than the motion had). So either can stand for the other, and where both are read they are
  compared.
- Layout `h3d263` at 20 fps keeps the vectors bit for bit. Made again from new_joints/ they are not the same:
  one more frame is lost, and the published code starts every clip with a forced heading that decoding has
  already turned into motion (docs/sources.md says how much). That way keeps each clip's own bone lengths,
  which are HumanML3D's uniform ones.
- `body133` (family `exact`) is made from the joints, or from the decoded vectors.
- Segment captions stay captions with start and end; what trains on them cuts the frames or the tokens. A
  mirrored clip `M<id>` names its original and stays in the split of its original.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.convert.common.arrays import load_array
from motionloom.datasets.convert.common.converter import Converter, PlanSettings
from motionloom.datasets.convert.common.features import features_of, require_human
from motionloom.datasets.convert.common.files import inside
from motionloom.datasets.convert.common.look import SourceJoints
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.splits import original_of
from motionloom.datasets.convert.humanml3d.plan import (
    FPS,
    WIDTHS,
    HumanMl3dClip,
    HumanMl3dConfig,
    plan_humanml3d,
)
from motionloom.datasets.motion.canonical import resample
from motionloom.datasets.motion.features.codec import decode
from motionloom.datasets.motion.features.h3d import encode_h3d
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.sample import Sample

AGREEMENT = 0.01
"""Metres by which new_joints/ may differ from decoded new_joint_vecs/; the published pairs agree to 1e-6."""


class HumanMl3d(Converter[HumanMl3dConfig, HumanMl3dClip]):
    """The HumanML3D converter."""

    name = "humanml3d"
    title = "HumanML3D"
    summary = "HumanML3D: new_joints or new_joint_vecs, texts and split files to shards."
    example = "HumanML3D shards"
    config_class = HumanMl3dConfig

    def plan(self, settings: PlanSettings) -> ConversionPlan[HumanMl3dClip]:
        return plan_humanml3d(self.config, settings)

    def depends_on(self, clip: HumanMl3dClip) -> list[object]:
        sizes = [(self.config.source / file).stat().st_size for file in clip.files]
        return [clip.id, clip.files, sizes, [caption.dump() for caption in clip.texts]]

    def joints(self, clip: HumanMl3dClip) -> SourceJoints:
        return SourceJoints(_joints(_load(self.config, clip, clip.files[0])), FPS)

    def convert(self, clip: HumanMl3dClip) -> Sample:
        config, layout = self.config, self.layout
        stored = [_load(config, clip, file) for file in clip.files]
        joints = _joints(stored[0])
        require_human(joints, FPS)
        if len(stored) > 1:
            _require_same(joints, _joints(stored[1]), clip)
        if config.keeps_vectors and stored[0].ndim == 2:
            motion = stored[0].astype(np.float32, copy=False)
        elif layout.family == "exact":
            motion = features_of(joints, FPS, layout, same_bones=config.retarget)
        else:
            bones = None if config.retarget else own_bones(joints, layout)
            motion = encode_h3d(resample(joints, FPS, layout.fps), layout, bones)
        meta = self.meta(clip, motion, licence=clip.licence, mirror_of=original_of(clip.id))
        return Sample(meta=meta, motion=motion, texts=list(clip.texts))


def own_bones(joints: NDArray[np.float64], layout: MotionLayout) -> NDArray[np.float64]:
    """Bones [N, 3] in metres of the first frame of joints [T, N, 3]; the root's is 0."""
    bones = np.zeros(joints.shape[1:])
    bones[1:] = joints[0, 1:] - joints[0, list(layout.skeleton.parents[1:])]
    return bones


def _load(
    config: HumanMl3dConfig, clip: HumanMl3dClip, file: str
) -> NDArray[np.float32] | NDArray[np.float64]:
    folder, name = file.split("/", 1)
    path = inside(config.source / folder, name, file)
    values = load_array(path, width=WIDTHS[folder], name=file)
    if len(values) != clip.frames:
        raise UserError(f"{file}: {len(values)} frames, {clip.frames} when the plan was made; convert again")
    return values


def _joints(stored: NDArray[np.float32] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Joints [T, 22, 3] of either file: stored [T, 22, 3], or vectors [T, 263] to decode."""
    if stored.ndim == 2:
        return decode(stored, MotionLayout.named("h3d263"))
    return stored.astype(np.float64)


def _require_same(joints: NDArray[np.float64], others: NDArray[np.float64], clip: HumanMl3dClip) -> None:
    away = np.linalg.norm(joints - others, axis=-1).max(axis=-1)
    if not away.max() <= AGREEMENT:
        raise UserError(
            f"{clip.label()}: differs from {clip.files[1]} by {away.max():.3g} m at frame "
            f"{int(away.argmax())}; choose one with --use vecs or --use joints"
        )
