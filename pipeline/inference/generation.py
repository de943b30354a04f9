"""What a request asks for, made by the generators of a bundle. `MotionModel` is the door to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.conditions import Condition, Conditions
from motionloom.datasets.modalities.table import MODALITIES
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.models.layers.seeds import FACES, sample_seeds
from motionloom.pipeline.contract.generation import GenerationRequest, MotionGenerator, Prompt, Stretch
from motionloom.pipeline.contract.stage import CompletedStage
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.generators.idle_pose import blend_to_idle
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.request import Request, frames_of, require_driven, seeds_of

if TYPE_CHECKING:
    from motionloom.pipeline.render.sound import Segment

AT_ONCE = 64
"""Motions sampled together."""
Columns = NDArray[np.float32]
"""A part's columns of a motion [T, C]."""


def generate(bundle: Bundle, request: Request, at_once: int = AT_ONCE) -> list[GeneratedMotion]:
    """The motions of a request, in order. `UserError` for one that the bundle's generators cannot meet."""
    motions = _along_script(bundle, request) if request.segments else _of_prompts(bundle, request, at_once)
    return [replace(motion, seed=request.seed) for motion in motions]


def _of_prompts(bundle: Bundle, request: Request, at_once: int) -> list[GeneratedMotion]:
    """One motion for each prompt, made in batches."""
    generator = bundle.generator
    prompts = request.prompts
    count = request.count
    require_driven(generator, prompts)
    frames = frames_of(generator, request.lengths, prompts)
    begun = seeds_of(generator, request.seed_motions, count)
    # One seed a motion, and one for its face, so that results do not depend on the others.
    seeds = sample_seeds(request.seed, count)
    face_seeds = sample_seeds(request.seed, count, FACES)
    noise_seeds = seeds if request.noise_seed is None else sample_seeds(request.noise_seed, count)
    sampling = bundle.drawing(request.sampling)
    out: dict[int, GeneratedMotion] = {}
    for rows in batches_by_length(frames, at_once):
        some = [prompts[row] for row in rows]
        asked = GenerationRequest(
            encode(bundle, bundle.main, some, [prompt.text for prompt in some]),
            _given([frames[row] for row in rows]),
            [seeds[row] for row in rows],
            sampling,
            [noise_seeds[row] for row in rows],
            begun and [begun[row] for row in rows],
        )
        made = _batch(bundle, some, asked, [face_seeds[row] for row in rows])
        out.update(zip(rows, made, strict=True))
    return [out[row] for row in range(count)]


def _given(frames: Sequence[int | None]) -> list[int] | None:
    """Lengths, of which all are given or none is."""
    return [count for count in frames if count is not None] or None


def batches_by_length(frames: Sequence[int | None], at_once: int) -> list[list[int]]:
    """Rows in batches, each all with a given length or all without; like lengths lie together, since a batch
    takes as long as its longest motion.
    """
    free = [row for row, count in enumerate(frames) if count is None]
    given = sorted(set(range(len(frames))) - set(free), key=lambda row: (frames[row], row))
    return [rows[i : i + at_once] for rows in (free, given) for i in range(0, len(rows), at_once)]


def _batch(
    bundle: Bundle, prompts: Sequence[Prompt], asked: GenerationRequest, face_seeds: Sequence[int]
) -> list[GeneratedMotion]:
    """Motions of prompts that all have a length or all have none."""
    layout = bundle.layout
    part = bundle.generator.part
    body = bundle.generator.generate(asked)
    # The face takes the body's length, so that both share one time line.
    lengths = [len(motion) for motion in body]
    faces: Sequence[Columns | None] = [None] * len(prompts)
    stage = bundle.choose_face(asked.sampling.face_model)
    if stage is not None:
        words = encode(bundle, stage, prompts, [prompt.words for prompt in prompts])
        face_request = GenerationRequest(words, lengths, face_seeds, asked.sampling)
        faces = bundle.generator_of(stage).generate(face_request)
    out = []
    for row, (prompt, motion, face) in enumerate(zip(prompts, body, faces, strict=True)):
        calm = blend_to_idle(motion, [prompt.idle], [len(motion)], layout, part)
        made = _motion(bundle, prompt, calm, face)
        # A model may end before its music does: beats after its last frame are none of the motion's.
        ticks = ticks_of(prompt, asked.conditions, row, layout.fps)
        beats = () if prompt.idle else tuple(tick for tick in ticks if tick < made.seconds)
        out.append(replace(made, beats=beats))
    return out


def _along_script(bundle: Bundle, request: Request) -> list[GeneratedMotion]:
    """One motion driven by segments of text and music in turn, and other samples of it (`script.py`)."""
    from motionloom.pipeline.inference.script import segment_frames, sound_of

    generator = bundle.generator
    fps = bundle.layout.fps
    samples = request.samples
    segments = request.segments
    sampling = bundle.drawing(request.sampling)
    drive = generator.capabilities.drive
    if drive is None:
        raise UserError(
            f"this model ({generator.method}) makes a motion of one prompt; scripts need a UDE model"
        )
    require_driven(generator, request.prompts)
    frames = [segment_frames(generator, segment, number) for number, segment in enumerate(segments)]
    lengths = [[count] * samples for count in frames]
    stretches = [
        Stretch(_repeated(encode(bundle, bundle.main, [prompt], [prompt.text]), samples), counts)
        for prompt, counts in zip(request.prompts, lengths, strict=True)
    ]
    idle = [prompt.idle for prompt in request.prompts]
    body = drive(stretches, sample_seeds(request.seed, samples), sampling)
    faces: list[Columns] | list[None] = [None] * samples
    stage = bundle.choose_face(sampling.face_model)
    if stage is not None:
        face_seeds = sample_seeds(request.seed, samples, FACES)
        pieces = []
        for prompt, counts in zip(request.prompts, lengths, strict=True):
            words = _repeated(encode(bundle, stage, [prompt], [prompt.words]), samples)
            face_request = GenerationRequest(words, counts, face_seeds, sampling)
            pieces.append(bundle.generator_of(stage).generate(face_request))
        faces = [np.concatenate(own) for own in zip(*pieces, strict=True)]
    # Segments last whole units of the generator, so the time line goes by frames, not by what was asked.
    ends = np.cumsum(frames) / fps
    starts = np.concatenate([[0], ends[:-1]])
    spans = list(zip(segments, starts, ends, strict=True))
    bands = tuple(segment.band(start, end) for segment, start, end in spans)
    beats = tuple(
        float(start + tick)
        for (segment, start, _), stretch, count in zip(spans, stretches, frames, strict=True)
        for tick in ticks_of(segment.prompt, stretch.conditions, 0, fps)
        if tick < count / fps and not segment.prompt.idle
    )
    sound = sound_of(list(zip(segments, frames, strict=True)), fps)
    whole = Prompt(text="; ".join(segment.label for segment in segments), sound=sound)
    out = []
    for motion, face in zip(body, faces, strict=True):
        calm = blend_to_idle(motion, idle, frames, bundle.layout, generator.part)
        out.append(replace(_motion(bundle, whole, calm, face, bands), beats=beats))
    return out


def _motion(
    bundle: Bundle, prompt: Prompt, motion: Columns, face: Columns | None, segments: tuple[Segment, ...] = ()
) -> GeneratedMotion:
    """The motion of columns of the body's generator, which may hold the face too."""
    layout = bundle.layout
    features = motion
    if bundle.generator.part == "all" and layout.has("face"):
        features = motion[:, layout.part("bodyhand")]
        face = motion[:, layout.part("face")] if face is None else face
    return GeneratedMotion(prompt, features, joints_of(features, layout), face, layout, segments)


def encode(
    bundle: Bundle, stage: CompletedStage, prompts: Sequence[Prompt], words: Sequence[str]
) -> Conditions:
    """The conditions of a stage's generator, one row a prompt; `words` are about its part of the body."""
    return encode_prompts(bundle.generator_of(stage), prompts, words, bundle.layout.fps, bundle.device)


def encode_prompts(
    generator: MotionGenerator,
    prompts: Sequence[Prompt],
    words: Sequence[str],
    fps: float,
    device: torch.device,
) -> Conditions:
    """The conditions of a generator, by what it was trained with; those that no prompt has are left out.

    `words` are the prompts' texts, about the body or the face; an empty one is no text.
    """
    rows = [replace(prompt, text=text).given for prompt, text in zip(prompts, words, strict=True)]
    out: dict[str, Condition] = {}
    for name, record in MODALITIES.items():
        given = [row.get(name) for row in rows]
        if name in generator.modalities and any(value is not None for value in given):
            features, mask, pooled = record.encode(generator.prepared.get(name), given, fps)
            pooled = None if pooled is None else pooled.to(device)
            out[name] = Condition(features.to(device), mask.to(device), pooled)
    return out


def ticks_of(prompt: Prompt, conditions: Conditions, row: int, fps: float) -> tuple[float, ...]:
    """Seconds worth marking on the time line of a row of encoded conditions: the beats of its music."""
    found: list[float] = []
    for name, (features, mask, _) in conditions.items():
        values = np.asarray(features[row][mask[row]].cpu(), np.float32)
        found += MODALITIES[name].ticks(prompt.given.get(name), values, fps)
    return tuple(found)


def _repeated(conditions: Conditions, count: int) -> Conditions:
    """Conditions of one row, for `count` rows."""
    return {
        name: Condition(
            features.expand(count, -1, -1),
            mask.expand(count, -1),
            None if pooled is None else pooled.expand(count, -1),
        )
        for name, (features, mask, pooled) in conditions.items()
    }
