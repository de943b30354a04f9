"""BVH and ASF/AMC -> shards: any skeleton, through a joint map (`datasets/motion/bvh/joint_map.py`)."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of_json
from motionloom.datasets.base.licences import credits_of, strictest
from motionloom.datasets.base.register import register
from motionloom.datasets.convert.bvh.config import BvhClip, BvhConfig
from motionloom.datasets.convert.bvh.maps import JointMaps, load_maps
from motionloom.datasets.convert.bvh.plan import plan_bvh
from motionloom.datasets.convert.bvh.settle import added_frames
from motionloom.datasets.convert.captions.humanml_index import CREDITS, WORDS_CREDIT
from motionloom.datasets.convert.common.converter import Converter, PlanSettings
from motionloom.datasets.convert.common.features import features_of
from motionloom.datasets.convert.common.look import SourceJoints, named_unit
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.motion.body.resting_hands import with_resting_hands
from motionloom.datasets.motion.bvh.joint_map import JointMap, metres, skeleton_key
from motionloom.datasets.motion.bvh.motion import BvhMotion
from motionloom.datasets.motion.canonical import mirror
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.plausibility import PERSON_METRES, measure
from motionloom.datasets.shards.sample import Sample


class Bvh(Converter[BvhConfig, BvhClip]):
    """The BVH converter."""

    name = "bvh"
    title = "BVH"
    summary = "BVH (and ASF/AMC) files of any skeleton to shards."
    example = "mocap shards --captions captions.jsonl --licence CC-BY-4.0"
    config_class = BvhConfig
    beside: ClassVar[tuple[str, ...]] = (".asf",)

    def __init__(self, config: BvhConfig) -> None:
        super().__init__(config)
        self.own_maps = load_maps(config.joint_map, config.mapped_skeleton())  # a wrong one fails here
        self.maps: JointMaps = {}

    def plan(self, settings: PlanSettings) -> ConversionPlan[BvhClip]:
        plan, self.maps = plan_bvh(self.config, self.own_maps, settings, self.published)
        return plan

    def depends_on(self, clip: BvhClip) -> list[object]:
        cut = [] if clip.span is None else [*clip.span, clip.fps, clip.mirror_of]
        return [clip.id, self._content(clip), [caption.dump() for caption in clip.texts], *cut]

    def _content(self, clip: BvhClip) -> str:
        """Digest of a clip's file and of how its joints are read."""
        used = self.maps.get(clip.found.skeleton)
        made_from = [clip.found.sha256, used.read_as() if used else None]
        cut = self.config.cut(clip.found.path)
        return sha256_of_json(made_from if cut == slice(None) else [*made_from, cut.start, cut.stop])

    def licence(self, plan: ConversionPlan[BvhClip]) -> str:
        return self.config.licence or (
            "" if self.config.humanml_index is None else strictest(plan.totals.licences)
        )

    def credits(self, plan: ConversionPlan[BvhClip]) -> list[str]:
        if self.config.humanml_index is None:
            return super().credits(plan)
        subsets = {str(clip.about["subset"]) for _, clip in plan.items}
        own = [CREDITS[subset] for subset in sorted(subsets) if subset in CREDITS]
        words = [WORDS_CREDIT] if self.config.humanml_texts else []
        return [*credits_of(plan.totals.licences, self.config.name, own), *words]

    def convert(self, clip: BvhClip) -> Sample:
        seen = self.joints(clip)
        motion = self.encode(clip, seen.joints)
        hands = self.layout.num_joints > BODY_JOINTS and self.config.fingers != "missing"
        meta = self.meta(clip, motion, seen=seen, hands=hands, licence=clip.licence, mirror_of=clip.mirror_of)
        return Sample(meta=meta, motion=motion, texts=list(clip.texts))

    def joints(self, clip: BvhClip) -> SourceJoints:
        """The joints as the map reads them."""
        joints, joint_map = self.world(clip, clip.read())
        up = joint_map.up or self.config.up
        return SourceJoints(joints, clip.fps, mapped=True, up=up, is_sized=not joint_map.measured)

    def stratum(self, clip: BvhClip) -> str:
        return f"{super().stratum(clip)} {clip.found.skeleton}"

    def encode(self, clip: BvhClip, joints: NDArray[np.floating]) -> NDArray[np.float32]:
        """Features [T', D] of the joints [T, N, 3] of a clip."""
        config = self.config
        joint_map = self.maps[clip.found.skeleton]
        try:
            if len(self.layout.skeleton) > joints.shape[1]:
                joints = with_resting_hands(joints)
            if clip.mirror_of is not None:
                joints = mirror(joints, self.layout.skeleton)
            return features_of(joints, clip.fps, self.layout, same_bones=config.retarget)
        except UserError as error:
            unit = joint_map.unit or config.unit
            up = joint_map.up or config.up
            raise UserError(f"{clip.label()}: {error} (read with unit '{unit}', up '{up}')") from None

    def world(self, clip: BvhClip, motion: BvhMotion) -> tuple[NDArray[np.float64], JointMap]:
        """Joints [T, N, 3] of a clip's motion in metres, Y up, without an added first frame; and the map
        that reads them.

        Where the unit is settled by the skeleton's first clips and makes no person of this one's figure, but
        another known unit does, that one counts: writers of one skeleton may use several.
        """
        config = self.config
        motion = replace(motion, values=motion.values[config.cut(clip.found.path)])
        joint_map = self.maps.get(skeleton_key(motion.joints, motion.parents))
        if joint_map is None:
            raise UserError(f"{motion.name}: its skeleton has no joint map")
        unit = joint_map.unit or ("cm" if config.unit == "auto" else config.unit)
        up = "y" if config.up == "auto" else config.up
        joints = joint_map.apply(motion, unit=unit, up=up)
        if joint_map.measured:
            height = measure(joints, motion.fps).height
            own = named_unit(height / metres(unit))
            if own is not None and not PERSON_METRES[0] <= height <= PERSON_METRES[1]:
                joints *= metres(own) / metres(unit)
        added = added_frames(joints)
        if clip.span is None:
            return joints[added:], joint_map
        # The index counts the recording's own frames: one is the writer's, those after it are only blended.
        first, last = clip.span
        return joints[min(added, 1) :][max(first, added - 1) : last], joint_map


register(Bvh)
