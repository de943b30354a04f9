"""A trained model ready to generate: a generator of body and hands, and one of the face where there is one.

A bundle opens from a run folder or from an exported one; both hold one folder a stage, and each stage loads
itself (`contract/stage.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.conditions import Conditions
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.layers.seeds import FACES, sample_seeds
from motionloom.pipeline.contract.captioning import MotionCaptioner
from motionloom.pipeline.contract.generation import GenerationRequest, MotionGenerator, Prompt, Stretch
from motionloom.pipeline.contract.lookup import captioners_of, exported_sampling, generators_of, open_exported
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import CAPTIONER, CPU, CompletedStage, StageCache
from motionloom.pipeline.inference.checks import find_mismatches, rounded_lengths, standing, unknown_captions
from motionloom.pipeline.inference.generators.idle_pose import blend_to_idle
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.requests import (
    alike,
    caption_list,
    encode_prompts,
    frames_of,
    prompts_of,
    repeated_rows,
    require_driven,
    require_samples,
    require_seed,
    require_used,
    require_words,
    seeds_of,
    split_columns,
    ticks_of,
)
from motionloom.pipeline.inference.script import DrivenSegment, segment_frames, sound_of
from motionloom.pipeline.inference.shipped_models import find_model
from motionloom.pipeline.render.sound import Segment
from motionloom.pipeline.store.artifact import Terms, require_consistent
from motionloom.pipeline.store.known_captions import Unknown
from motionloom.pipeline.store.run_folder import BUNDLE_FILE, hint_at, owner_of

if TYPE_CHECKING:
    from motionloom.datasets.audio.sound import Sound

_AT_ONCE = 64
"""Motions sampled together."""
_NO_BODY = "no finished stage here generates body motion; run the recipe to the end first"


class Bundle:
    """The generators of a model, loaded at once so that a broken one is found first, all on one device."""

    def __init__(
        self,
        stages: Sequence[CompletedStage],
        stage_cache: StageCache,
        recommended: SamplingConfig | None = None,
        captioners: Sequence[CompletedStage] = (),
    ) -> None:
        self.stages, self.captioners = tuple(stages), tuple(captioners)
        """The stages that generate, the default of each kind first; and those that caption motions."""
        self.terms = Terms.of(stage.folder for stage in (*self.stages, *self.captioners))
        """Licences and credits of all data that it was made from."""
        self.stage_cache = stage_cache
        self.recommended = recommended or SamplingConfig()
        """Recommended sampling settings; fields that are not set have no recommendation."""
        self._generators: dict[Path, MotionGenerator] = {}
        for stage in (*self.stages, *self.captioners):
            self._open(stage)
        if {self.of(stage).part for stage in self.stages} <= {"face"} and not self.captioners:
            raise UserError(_NO_BODY)

    @staticmethod
    def open(name: Path | str, device: torch.device = CPU) -> Bundle:
        """Open a run folder, an exported folder, a model that comes with the package, or one of the hub."""
        folder = find_model(name)
        if (folder / BUNDLE_FILE).is_file():
            found = open_exported(folder), StageCache(device), exported_sampling(folder)
            return Bundle._of(folder, (*found, open_exported(folder, CAPTIONER)))
        if not (folder / "recipe.yaml").is_file():
            raise UserError(
                f"{folder}: not a run folder (no recipe.yaml) and not an exported one (no {BUNDLE_FILE})"
            )
        return Bundle.from_run(folder, device)

    @staticmethod
    def from_run(run: Path, device: torch.device = CPU) -> Bundle:
        makers, captioners = generators_of(run), captioners_of(run)
        for stage in (*makers, *captioners):
            require_consistent(owner_of(stage.folder), [stage.folder.name])
        return Bundle._of(run, (makers, StageCache(device), None, captioners))

    @staticmethod
    def _of(folder: Path, found: tuple[Any, ...]) -> Bundle:
        try:
            return Bundle(*found)
        except UserError as error:
            if str(error).startswith(str(folder)):
                raise
            hint = hint_at(folder) if str(error) == _NO_BODY else ""
            raise UserError(f"{folder}: {error}{hint}") from None

    def _open(self, stage: CompletedStage) -> None:
        """Load a stage's inputs, and theirs, as far as generation needs them."""
        needed, inputs = stage.kind.exported(stage.config), self.stage_cache.given(stage.inputs)
        for role in stage.kind.roles():
            if role.name in needed and (role.name in inputs or not role.optional):
                inputs[role.name]  # looking it up loads it, so a broken one is found before anything is made
                self._open(stage.inputs[role.name])

    def of(self, stage: CompletedStage) -> MotionGenerator:
        """The generator that a stage is."""
        if stage.folder not in self._generators:
            self._generators[stage.folder] = self.stage_cache.generator(stage)
        return self._generators[stage.folder]

    @cached_property
    def main(self) -> CompletedStage:
        """The stage that generates body and hands."""
        for stage in self.stages:
            if self.of(stage).part != "face":
                return stage
        raise UserError(_NO_BODY)

    @property
    def generator(self) -> MotionGenerator:
        return self.of(self.main)

    @cached_property
    def faces(self) -> dict[str, CompletedStage]:
        """The stages that generate faces, by method; the first is the default."""
        out: dict[str, CompletedStage] = {}
        for stage in self.stages:
            if self.of(stage).part == "face":
                out.setdefault(self.of(stage).method, stage)
        return out

    def choose_face(self, wanted: str | None) -> CompletedStage | None:
        """The face generator asked for by its method or stage, else the first; None where there is none."""
        if wanted is None:
            return next(iter(self.faces.values()), None)
        named = {stage.name: stage for stage in self.faces.values()} | self.faces
        if wanted not in named:
            raise UserError(
                f"no face generator '{wanted}' here; there is {', '.join(self.faces) or 'none'}: "
                f"train its stage or choose another"
            )
        return named[wanted]

    @cached_property
    def captioner(self) -> MotionCaptioner:
        """The captioner: the recipe's first."""
        if not self.captioners:
            raise UserError("no finished stage here captions motion; add one of kind captioner to the recipe")
        return self.stage_cache.captioner(self.captioners[0])

    @property
    def layout(self) -> MotionLayout:
        return self.generator.layout if self.stages else self.captioner.layout

    @property
    def device(self) -> torch.device:
        """Where all networks lie; what is made comes back as numpy arrays."""
        return self.stage_cache.device

    @property
    def max_seconds(self) -> float:
        """Longest motion; infinite where there is no limit."""
        frames = self.generator.max_frames
        return math.inf if frames is None else frames / self.layout.fps

    def require_used(self, face_captions: Iterable[str] | None, sampling: SamplingConfig) -> None:
        """Refuse settings that were given, and that no generator in use takes notice of."""
        stage, faces = self.choose_face(sampling.face_model), {m: self.of(s) for m, s in self.faces.items()}
        face = None if stage is None else self.of(stage)
        require_used(self.generator, faces, face, face_captions, sampling)

    def drawing(self, sampling: SamplingConfig | None = None) -> SamplingConfig:
        """Return the sampling settings, unset fields as the model recommends."""
        return self.recommended if sampling is None else sampling.over(self.recommended)

    def in_effect(self, sampling: SamplingConfig | None = None) -> dict[str, object]:
        """The settings that motions are drawn with, of those that the generators in use take notice of."""
        sampling = self.drawing(sampling)
        face = self.choose_face(sampling.face_model)
        used = [self.generator, *([] if face is None else [self.of(face)])]
        noticed = frozenset[str]().union(*(generator.settings for generator in used))
        out: dict[str, object] = {name: value for name, value in sampling.dump().items() if name in noticed}
        for generator, prefix in zip(used, ("", "face_"), strict=False):
            if (denoising := generator.capabilities.denoising) is not None:
                sampler, steps = denoising(sampling)
                out |= {f"{prefix}sampler": sampler, f"{prefix}denoising_steps": steps}
        return {name: value for name, value in out.items() if value not in (None, {})}

    def generate(
        self,
        captions: Sequence[str] | None = None,
        *,
        face: Sequence[str] | None = None,
        sounds: Sequence[Sound | None] | None = None,
        conditions: Mapping[str, Sequence[object]] | None = None,
        seconds: float | Sequence[float | None] | None = None,
        seed: int = 0,
        noise_seed: int | None = None,
        sampling: SamplingConfig | None = None,
        seed_motions: Sequence[NDArray[np.float32]] | None = None,
        batch: int = _AT_ONCE,
        strict: bool = False,
    ) -> list[GeneratedMotion]:
        """Motions for captions, sounds or both, in order; equal arguments give equal motions.

        As `MotionModel.generate`. `conditions` are more of what motions are conditioned on, by modality: of
        "audio" the sounds' features [T, 438], where they are known, such as those that a data set stores.
        `noise_seed` decodes the same tokens with other noise, where a diffusion model decodes. `seed_motions`
        are the layout's columns [T0, D] of motions that a generator with `seed_frames` goes on from, one for
        each or one for all. With `strict`, empty captions and options without effect are refused.
        """
        require_seed(seed)
        texts = None if captions is None else caption_list(captions)
        faces = None if face is None else caption_list(face, "face")
        if strict:
            require_words(faces or [], "face")
            self.require_used(faces, sampling or SamplingConfig())
        sampling = self.drawing(sampling)
        prompts = prompts_of(texts, faces, sounds, conditions)
        require_driven(self.generator, prompts)
        frames = frames_of(self.generator, seconds, prompts)
        begun = seeds_of(self.generator, seed_motions, len(prompts))
        # One seed per motion, and one for its face, so that results do not depend on the others.
        seeds, face_seeds = sample_seeds(seed, len(prompts)), sample_seeds(seed, len(prompts), FACES)
        noise = seeds if noise_seed is None else sample_seeds(noise_seed, len(prompts))
        out: dict[int, GeneratedMotion] = {}
        for rows in alike(frames, batch):
            own = tuple([draws[row] for row in rows] for draws in (seeds, face_seeds, noise))
            some = [prompts[row] for row in rows], [frames[row] for row in rows]
            made = self._batch(*some, own, sampling, begun and [begun[row] for row in rows])
            out.update((row, replace(one, seed=seed)) for row, one in zip(rows, made, strict=True))
        return [out[row] for row in range(len(prompts))]

    def unknown_captions(
        self, captions: Sequence[str], face: Sequence[str] = (), face_model: str | None = None
    ) -> list[Unknown]:
        """Return captions unlike all that were trained on; none where a model does not say what it knows."""
        out: list[Unknown] = []
        for stage, texts in ((self.main, captions), (self.choose_face(face_model), face)):
            source = None if stage is None else self.of(stage).prepared.get("text")
            out += unknown_captions(source, texts, face=texts is face)
        return out

    def notes(
        self,
        prompts: Sequence[Prompt],
        motions: Sequence[GeneratedMotion] = (),
        face_model: str | None = None,
        seconds: float | Sequence[float | None] | None = None,
    ) -> list[Unknown | str]:
        """Return the notes on prompts, and on motions whose length is not the one asked for (`seconds`)."""
        texts, faces = [prompt.text for prompt in prompts], [prompt.face_text for prompt in prompts]
        remarks = dict.fromkeys(prompt.remark for prompt in prompts if prompt.remark)
        shown = [*rounded_lengths(self.generator, seconds, motions), *standing(motions)]
        shown += self.find_mismatches(motions)
        return [*self.unknown_captions(texts, faces, face_model), *remarks, *shown]

    def find_mismatches(self, motions: Iterable[GeneratedMotion]) -> list[str]:
        """Return a sentence for each caption, scripts apart, of which its motions show something else."""
        source = self.generator.prepared.get("text")
        single = ((motion.caption, motion.joints) for motion in motions if not motion.segments)
        return find_mismatches(source, single, self.layout.fps)

    def perform(
        self,
        segments: Sequence[DrivenSegment],
        *,
        samples: int = 1,
        seed: int = 0,
        sampling: SamplingConfig | None = None,
    ) -> list[GeneratedMotion]:
        """One motion driven by segments of text and music in turn, and other samples of it (`script.py`)."""
        sampling, generator, fps = self.drawing(sampling), self.generator, self.layout.fps
        require_seed(seed)
        require_samples(samples)
        drive = generator.capabilities.drive
        if drive is None:
            raise UserError(
                f"this model ({generator.method}) makes a motion of one prompt; scripts need a UDE model"
            )
        require_driven(generator, [segment.prompt for segment in segments])
        frames = [segment_frames(generator, segment, number) for number, segment in enumerate(segments)]
        stretches = [
            Stretch(
                repeated_rows(self.encode(self.main, [segment.prompt], [segment.prompt.text]), samples),
                [count] * samples,
            )
            for segment, count in zip(segments, frames, strict=True)
        ]
        idle = [segment.prompt.idle for segment in segments]
        body = [
            blend_to_idle(motion, idle, frames, self.layout, generator.part)
            for motion in drive(stretches, sample_seeds(seed, samples), sampling)
        ]
        faces = self._faces(segments, frames, sample_seeds(seed, samples, FACES), sampling)
        # Segments last whole units of the generator, so the time line goes by frames, not by what was asked.
        starts = np.concatenate([[0], np.cumsum(frames)]) / fps
        bands = tuple(s.band(a, b) for s, a, b in zip(segments, starts, starts[1:], strict=False))
        beats = tuple(
            float(start + tick)
            for segment, stretch, start, count in zip(segments, stretches, starts, frames, strict=False)
            for tick in ticks_of(segment.prompt, stretch.conditions, 0, fps)
            if tick < count / fps and not segment.prompt.idle
        )
        sound = sound_of(list(zip(segments, frames, strict=True)), fps)
        whole = Prompt(text="; ".join(segment.label for segment in segments), sound=sound)
        return [
            replace(self._motion(whole, motion, face, bands), seed=seed, beats=beats)
            for motion, face in zip(body, faces, strict=True)
        ]

    def encode(self, stage: CompletedStage, prompts: Sequence[Prompt], words: Sequence[str]) -> Conditions:
        """The conditions of a stage's generator, one row a prompt; `words` are about its part of the body."""
        return encode_prompts(self.of(stage), prompts, words, self.layout.fps, self.device)

    def _faces(
        self,
        segments: Sequence[DrivenSegment],
        frames: Sequence[int],
        seeds: Sequence[int],
        sampling: SamplingConfig,
    ) -> list[NDArray[np.float32] | None]:
        """The expressions of a script, segment after segment; None where the model has no face generator."""
        stage = self.choose_face(sampling.face_model)
        if stage is None:
            return [None] * len(seeds)
        made = []
        for segment, count in zip(segments, frames, strict=True):
            conditions = self.encode(stage, [segment.prompt], [segment.prompt.words])
            rows = repeated_rows(conditions, len(seeds))
            request = GenerationRequest(rows, [count] * len(seeds), seeds, sampling)
            made.append(self.of(stage).generate(request))
        return [np.concatenate(pieces) for pieces in zip(*made, strict=True)]

    def _motion(
        self,
        prompt: Prompt,
        motion: NDArray[np.float32],
        face: NDArray[np.float32] | None,
        segments: tuple[Segment, ...] = (),
    ) -> GeneratedMotion:
        """The motion of columns [T, C] of the body's generator, which may hold the face too."""
        features, own_face = split_columns(motion, self.generator, self.layout)
        joints = joints_of(features, self.layout)
        expression = own_face if face is None else face
        return GeneratedMotion(prompt, features, joints, expression, self.layout, segments)

    def _batch(
        self,
        prompts: list[Prompt],
        frames: list[int | None],
        seeds: Sequence[list[int]],
        sampling: SamplingConfig,
        seed_motions: list[NDArray[np.float32]] | None,
    ) -> list[GeneratedMotion]:
        """Motions of prompts that all have a length or all have none; seeds of body, face and noise."""
        generator, layout = self.generator, self.layout
        conditions = self.encode(self.main, prompts, [prompt.text for prompt in prompts])
        lengths = None if None in frames else [count for count in frames if count is not None]
        request = GenerationRequest(conditions, lengths, seeds[0], sampling, seeds[2], seed_motions)
        body = generator.generate(request)
        face: list[NDArray[np.float32]] | list[None] = [None] * len(prompts)
        stage = self.choose_face(sampling.face_model)
        if stage is not None:
            words = self.encode(stage, prompts, [prompt.words for prompt in prompts])
            # The face takes the body's length, so that both share one time line.
            lengths = [len(motion) for motion in body]
            face = self.of(stage).generate(GenerationRequest(words, lengths, seeds[1], sampling))
        # After the face, which needs nothing of the body but its length.
        body = [
            blend_to_idle(motion, [prompt.idle], [len(motion)], layout, generator.part)
            for motion, prompt in zip(body, prompts, strict=True)
        ]
        made = [self._motion(*row) for row in zip(prompts, body, face, strict=True)]
        # A model may end before its music does: beats after its last frame are none of the motion's.
        ticks = [ticks_of(prompt, conditions, row, layout.fps) for row, prompt in enumerate(prompts)]
        return [
            replace(one, beats=() if one.prompt.idle else tuple(t for t in own if t < one.seconds))
            for one, own in zip(made, ticks, strict=True)
        ]
