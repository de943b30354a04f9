"""Clips of Motion-X's layout fixture by name, for the tests of its plan and of its converter."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from motionloom.datasets.convert.common.release import ReleaseClip
from motionloom.datasets.convert.motionx.convert import MotionXConfig, MotionXEntry
from motionloom.datasets.convert.registry import prepare

WAVE = "idea400/subset_0001/bandai_wave_right_hand_clip_1"
TURN = "idea400/subset_0001/bandai_Walking_And_Turn_Left_clip_2"
BOW = "perform/subset_0000/bandai_bow_happily"
MUG = "GRAB/s1/synthetic_mug_toast_1"
CHAT = "EgoBody/recording_20990101_S01_S01_01/body_idx_0/synthetic_stand_casual_chat_clip1"
DANCE = "aist/subset_0004/synthetic_Dance_Krump_Stomp_clip_3"
HUMANML, MIRRORED = "humanml/900001", "humanml/M900001"
ALL = {WAVE, TURN, BOW, MUG, CHAT, DANCE, HUMANML, MIRRORED}
MOTION = "motion_data/smplx_322"
TEXTS = "texts/semantic_labels"
FACES = "face_motion_data/smplx_322"


def config(folder: Path, **changes: Any) -> MotionXConfig:
    return MotionXConfig(source=folder, **changes)


def clips_of(folder: Path, **changes: Any) -> dict[str, ReleaseClip]:
    return {clip.id: clip for _, clip in prepare(config(folder, **changes)).plan.items}


def planned(folder: Path, **changes: Any) -> dict[str, MotionXEntry]:
    return {clip_id: clip.entry for clip_id, clip in clips_of(folder, **changes).items()}
