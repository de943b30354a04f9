"""Synthetic clips from (seed, index) alone, and shards of them.

`make_clip` is a pure function: a clip does not depend on how many there are, on the worker that makes it or
on its neighbours. `synthesize` writes them through the shard writer like any other converter.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from motionloom.datasets.actions.dances import Record
from motionloom.datasets.actions.hands import HANDS
from motionloom.datasets.audio.features import VERSION as AUDIO_VERSION
from motionloom.datasets.audio.features import settings_at
from motionloom.datasets.base.config import Config
from motionloom.datasets.base.records import Caption, Manifest, Split
from motionloom.datasets.motion.canonical import canonicalize
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.features.smpl75 import smpl75_of
from motionloom.datasets.motion.layout import BODY_JOINTS, MotionLayout
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import write_dataset
from motionloom.datasets.synth.actions import arms, floor, legs, locomotion
from motionloom.datasets.synth.actions.maths import Array, ease
from motionloom.datasets.synth.actions.pose import OVERLAP, Track, joined
from motionloom.datasets.synth.actions.truth import ACTIONS, BASIC, SEATED, Span, Truth, draw, require_known
from motionloom.datasets.synth.captions import Wordings, body_captions, face_captions
from motionloom.datasets.synth.choreography import choreograph, dancing_face, dancing_hands
from motionloom.datasets.synth.dances import Dance, DanceConfig, DanceTruth, dance, plan_dance
from motionloom.datasets.synth.hands_and_face import express, grip_hand, shape_hand
from motionloom.datasets.synth.music.recording import PLAYED, player, render_song, song_features
from motionloom.datasets.synth.stances import PACE, Poses, settle

CONVERTER_VERSION = 3  # runs in a circle, four jumps, who sits and then waves
LICENCE = "CC0-1.0"
SIZE_SPREAD = 0.02
"""Standard deviation of body size, as a fraction; `smpl75` holds no shape."""
SAMPLE_RATE = 16_000
"""Hz of the sound of dances."""
_GOLDEN = 0.6180339887498949
_REST_ROOT = Skeleton.named("smpl22").rest_joints[0]

Animator = Callable[[Truth, Span, float, np.random.Generator], Track]
ANIMATORS: dict[str, Animator] = {
    "walk": locomotion.walk,
    "turn": locomotion.turn,
    "run": locomotion.run,
    "jump": legs.jump,
    "squat": legs.squat,
    "sit": legs.sit,
    "kick": legs.kick,
    "punch": arms.punch,
    "wave": arms.wave,
    "clap": arms.clap,
    "raise": arms.lift,
    "reach": arms.reach,
    "bow": legs.bow,
    "dance": dance,
    "point": arms.reach,
    "hop": legs.jump,
    "lie": floor.lie,
    "crawl": floor.crawl,
    "stretch": arms.lift,
}
UNPACED = ("jump", "hop", "run", "dance")
"""Actions at the pace of gravity or of music."""


class SynthConfig(Config):
    """Settings of synthetic clips."""

    clips: int = Field(512, ge=1, le=10**8)
    seed: int = Field(0, ge=0, lt=2**63)
    layout: Literal["body133", "wholebody313", "wholebody363", "smpl75"] = "wholebody363"
    fps: float | None = Field(None, gt=4, le=240)
    """None = the layout's usual frame rate (30 for whole body, 20 for body only and SMPL)."""
    actions: list[str] | Literal["basic", "all"] = "basic"
    """Names of `truth.ACTIONS`, or all of them, or the basic ones: all but pointing, hopping, lying down,
    crawling, stretching and two actions in turn."""
    hand_shapes: list[str] | None = None
    """Shapes of free hands besides relaxed ones; [relaxed] for no others. None = all of `HANDS`."""
    min_seconds: float = Field(2.0, ge=1.0)
    max_seconds: float = Field(6.0, le=60.0)
    val_fraction: float = Field(0.05, ge=0, lt=1)
    test_fraction: float = Field(0.15, ge=0, lt=1)
    wordings: Wordings = "few"
    """Words that captions are made of: two or three for each thing in sentences of one form, or a dozen in
    many forms, for models that shall take more words than their training's. Dances of `dances` have few."""
    poses: Poses = "few"
    """How people stand and how quick they are: arms hanging, for half a second before and after an action,
    all at one pace; or each as she likes and at her own, cut where she moves. Dances of `dances` have few."""
    hold_out: list[Record] = Field(default_factory=list)
    """Combinations of truth values kept for testing, for example `[{"action": "kick", "side": "left"}]`."""
    hold_out_val: list[Record] = Field(default_factory=list)
    """Others kept for validation, so that nothing that new combinations decide is chosen on test clips."""
    dances: DanceConfig | None = None
    """Dances to songs of several genres, each with its own way of dancing. None = dances without music."""

    @field_validator("actions")
    @classmethod
    def _known_actions(cls, names: list[str] | str) -> list[str] | str | None:
        return names if isinstance(names, str) else require_known(names, ACTIONS, "action")

    @field_validator("hand_shapes")
    @classmethod
    def _known_shapes(cls, names: list[str] | None) -> list[str] | None:
        return require_known(names, HANDS, "hand shape")

    @field_validator("hold_out", "hold_out_val")
    @classmethod
    def _attributes(cls, combinations: list[Record]) -> list[Record]:
        for combination in combinations:
            require_known(list(combination), tuple(DanceTruth.__dataclass_fields__), "truth attribute")
        return combinations

    @model_validator(mode="after")
    def _consistent(self) -> SynthConfig:
        if self.max_seconds < max(5.0, self.min_seconds):
            raise ValueError(
                "max_seconds must be at least 5 (repeated squats need it) and at least min_seconds"
            )
        if self.val_fraction + self.test_fraction >= 1:
            raise ValueError("val_fraction and test_fraction leave nothing to train on")
        dances = self.dances
        if dances is not None and dances.share is None and "dance" not in self.action_names:
            raise ValueError("`dances` is given but `actions` has no dance; add it, or give dances.share")
        if dances is not None and dances.share is not None and dances.share < 1 and not self.other_actions:
            raise ValueError("dances.share below 1 needs other actions than dance")
        if dances is not None and dances.song_seconds < self.min_seconds:
            raise ValueError("dances.song_seconds is below min_seconds: no clip fits into a song")
        return self

    @property
    def action_names(self) -> list[str]:
        named = {"basic": list(BASIC), "all": list(ACTIONS)}
        return self.actions if isinstance(self.actions, list) else named[self.actions]

    @property
    def other_actions(self) -> list[str]:
        return [action for action in self.action_names if action != "dance"]

    @property
    def motion_layout(self) -> MotionLayout:
        """The layout at the frame rate of this config."""
        return MotionLayout.named(self.layout, fps=self.fps)


@dataclass(frozen=True)
class Clip:
    """One generated clip before it is encoded."""

    joints: Array
    """Canonical joint positions [T, N, 3], metres."""
    face: Array
    """Expression values [T, 50]."""
    texts: list[str]
    face_texts: list[str]
    truth: Record
    wav: tuple[NDArray[np.float32], int] | None
    """Mono samples and their rate; only dances have it."""
    audio: NDArray[np.float32] | None = None
    """Audio features [T, 438], one row per frame; only dances to songs have them."""
    smpl: NDArray[np.float32] | None = None
    """SMPL columns [T, 75] that pose the joints; only in layout `smpl75`."""


def make_clip(index: int, config: SynthConfig) -> Clip:
    """Clip `index` of a config; a pure function of (config, index)."""
    layout = config.motion_layout
    planned = dance_of(index, config)
    truth = planned.truth if planned else truth_of(index, config)
    hands = layout.num_joints > BODY_JOINTS
    has_face = layout.has("face")
    motion, shape = (np.random.default_rng([config.seed, index, k]) for k in (1, 2))
    if planned:
        begin = planned.seconds(layout.fps)
        track = choreograph(planned.song, begin, planned.frames, layout.fps, motion)
    else:
        span = Span(config.min_seconds, config.max_seconds)
        everyday = config.poses == "everyday"
        pace = motion.uniform(*PACE) if everyday else 1.0
        track = animate(truth, span, layout.fps, motion, pace)
        if everyday and truth.action != "dance":
            track = settle(track, config.min_seconds, motion)
    if hands and planned:
        track.fingers = dancing_hands(planned.song, begin, track.t, shape)
    elif hands and not truth.parts:
        track.fingers = np.stack([shape_hand(truth.hand(side), track.t, shape) for side in (0, 1)])
    # The shape's generator goes on after the hands: its order is part of what a seed means.
    solved = track.solve()
    size = float(np.clip(1 + SIZE_SPREAD * shape.standard_normal(), 0.8, 1.2))
    smpl = None
    if layout.name == "smpl75":
        size = 1.0
        smpl = smpl75_of(track.rotations(), solved, _REST_ROOT)
    face = (
        dancing_face(planned.song, begin, track.t, shape) if planned else express(truth.face, track.t, shape)
    )
    audio = wav = None
    if planned and config.dances and planned.comes in ("audio", "both"):
        song = planned.song
        rate = SAMPLE_RATE
        end = planned.start + planned.frames
        audio = song_features(song, rate, layout.fps, config.dances.width)[planned.start : end]
        first = round(begin * rate)
        samples = round(planned.frames / layout.fps * rate)
        wav = render_song(song, rate)[first : first + samples], rate
    texts, face_texts = captions_of(index, config)
    return Clip(
        joints=canonicalize(solved[:, : layout.num_joints] * size),
        face=face,
        texts=texts,
        face_texts=face_texts,
        truth=truth.record(hands=hands, face=has_face),
        wav=wav,
        audio=audio,
        smpl=smpl,
    )


def captions_of(index: int, config: SynthConfig) -> tuple[list[str], list[str]]:
    """Return the body and face captions of clip `index` without making its motion."""
    planned = dance_of(index, config)
    if planned is not None and planned.comes not in ("text", "both"):
        return [], []
    truth = planned.truth if planned else truth_of(index, config)
    layout = config.motion_layout
    words = np.random.default_rng([config.seed, index, 3])
    texts = body_captions(truth, words, layout.num_joints > BODY_JOINTS, config.wordings)
    face_texts = face_captions(truth, words, body=texts, wordings=config.wordings)
    return texts, face_texts if layout.has("face") else []


def animate(truth: Truth, span: Span, fps: float, rng: np.random.Generator, pace: float = 1.0) -> Track:
    """The body of one action, or of two in turn with their hands, `pace` times as quick as usual."""
    if truth.parts is None:
        if truth.action in UNPACED:
            return ANIMATORS[truth.action](truth, span, fps, rng)
        # At another frame rate, whose frames are then taken for those of `fps`.
        slow = replace(span, low=span.low * pace, high=span.high * pace)
        track = ANIMATORS[truth.action](truth, slow, fps / pace, rng)
        track.t = track.t / pace
        track.fps = fps
        return track
    # Each is as long as half of the span allows; the second begins where the first has ended.
    before, after = truth.parts
    half = Span(1.9, 0.5 * (span.high + OVERLAP), returns=True)
    seated = before.action == "sit" and after.action in SEATED
    first = animate(before, replace(half, returns=not seated), fps, rng, pace)
    second = animate(after, replace(half, returns=after.action != "sit"), fps, rng, pace)
    if seated:
        second.hold_lower_body(first)
    track = joined(first, second)
    change = len(first.t) / fps - 0.5 * OVERLAP
    for side in (0, 1):
        # The same noise on both sides of the change, where the hand is relaxed.
        seed = int(rng.integers(2**32))
        grips = (ease((change - track.t) / 0.3), ease((track.t - change) / 0.3))
        closed, opened = (
            grip_hand(part.hand(side), track.t, grip, np.random.default_rng(seed))
            for part, grip in zip(truth.parts, grips, strict=True)
        )
        track.fingers[side] = np.where((track.t < change)[:, None, None, None], closed, opened)
    return track


def dance_of(index: int, config: SynthConfig) -> Dance | None:
    """The dance to a song that clip `index` is; None for another action, or where dances have no songs."""
    if config.dances is None:
        return None
    action, number = _action_of(index, config)
    if action != "dance":
        return None
    span = Span(config.min_seconds, config.max_seconds)
    return plan_dance(number, index, config.dances, config.seed, span, config.motion_layout.fps)


def truth_of(index: int, config: SynthConfig) -> Truth:
    """Return the truth of clip `index`. Actions come in shuffled rounds, so any number is balanced."""
    planned = dance_of(index, config)
    if planned:
        return planned.truth
    rng = np.random.default_rng([config.seed, index, 0])
    return draw(_action_of(index, config)[0], rng, config.hand_shapes or HANDS[1:])


def _action_of(index: int, config: SynthConfig) -> tuple[str, int]:
    """Action of clip `index`, and which round of the actions (for a dance: which dance) it is."""
    actions = config.action_names
    rank = index
    share = config.dances.share if config.dances else None
    if share is not None:
        before = int(np.floor(index * share + 1e-9))
        if int(np.floor((index + 1) * share + 1e-9)) > before:
            return "dance", before
        actions = config.other_actions
        rank = index - before
    block, place = divmod(rank, len(actions))
    order = np.random.default_rng([config.seed, block, 101]).permutation(len(actions))
    return actions[int(order[place])], block


def split_of(index: int, config: SynthConfig) -> Split:
    """Split of a clip: held-out combinations test or validate, dances to songs by their song, the others by a
    low-discrepancy sequence."""
    return _split(index, config)[0]


def _split(index: int, config: SynthConfig) -> tuple[Split, Truth]:
    """Split and truth of a clip."""
    planned = dance_of(index, config)
    truth = planned.truth if planned else truth_of(index, config)
    kept: tuple[tuple[Split, list[Record]], ...] = (("test", config.hold_out), ("val", config.hold_out_val))
    for split, combinations in kept:
        if any(_is_of(truth, combination) for combination in combinations):
            return split, truth
    if planned and config.dances:
        return config.dances.split(planned.song, config.test_fraction, config.val_fraction), truth
    share = (index * _GOLDEN + 0.5 + config.seed * 0.7548776662466927) % 1.0
    if share < config.test_fraction:
        return "test", truth
    return "val" if share < config.test_fraction + config.val_fraction else "train", truth


def _is_of(truth: Truth, combination: Record) -> bool:
    return all(getattr(truth, key, None) == value for key, value in combination.items())


def make_sample(index: int, config: SynthConfig) -> Sample:
    """Clip `index` encoded for the shard writer."""
    layout = config.motion_layout
    clip = make_clip(index, config)
    has_face = layout.has("face")
    motion = clip.smpl
    if motion is None:
        motion = encode(clip.joints, layout, face=clip.face if has_face else None)
    meta = layout.clip_meta(
        f"synth-{config.seed}-{index:06d}",
        source=f"synthetic seed {config.seed} clip {index}",
        split=split_of(index, config),
        frames=len(motion),
        licence=LICENCE,
        has_hands=layout.num_joints > BODY_JOINTS,
        has_face=has_face,
        truth=clip.truth,
    )
    return Sample(
        meta=meta,
        motion=motion,
        texts=[Caption(text=text, source="synthetic") for text in clip.texts],
        face_texts=[Caption(text=text, source="synthetic") for text in clip.face_texts],
        audio=clip.audio,
        wav=clip.wav,
    )


def synthesize(config: SynthConfig, out: Path, workers: int = 1, progress: bool = True) -> Manifest:
    """Write the clips of a config as shards under `out`; the same config gives the same bytes."""
    options = config.dump()
    audio = None
    if config.dances is not None:
        options["audio_version"] = AUDIO_VERSION
        if config.dances.music == PLAYED:
            player(PLAYED).version()  # who lacks an instrument learns it before the first clip
        audio = settings_at(config.motion_layout.fps).dump()
    splits = [_split(index, config) for index in range(config.clips)]
    for combination in (*config.hold_out, *config.hold_out_val):
        if not any(_is_of(truth, combination) for _, truth in splits):
            warnings.warn(f"hold_out: none of {config.clips} clips is of {combination}", stacklevel=2)
    return write_dataset(
        out,
        [(split, index) for index, (split, _) in enumerate(splits)],
        partial(make_sample, config=config),
        DatasetFacts(
            name="synth",
            layout=config.motion_layout,
            licence=LICENCE,
            converter="synth",
            converter_version=CONVERTER_VERSION,
            options=options,
            audio=audio,
        ),
        WriteOptions(workers=workers, seed=config.seed, strict=True, progress=progress),
    )
