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

from motionloom.datasets.conditions import Condition, Conditions
from motionloom.datasets.motion.joints import joints_of
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import UserError
from motionloom.models.gpt.drawing import sample_seeds
from motionloom.pipeline.contract.exported import exported_sampling, open_exported
from motionloom.pipeline.contract.generation import (
    DrivenGenerator,
    GenerationRequest,
    MotionGenerator,
    Prompt,
    Stretch,
)
from motionloom.pipeline.contract.lookup import generators_of
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import CPU, Finished, Shelf
from motionloom.pipeline.inference.conditions import PromptEncoder
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.requests import (
    caption_list,
    prompts_of,
    require_driven,
    require_seed,
    require_used,
    require_words,
    sampling_of,
)
from motionloom.pipeline.inference.script import DrivenSegment, segment_frames, sound_of
from motionloom.pipeline.inference.shipped_models import model_folder, no_such_model, say_model
from motionloom.pipeline.render.score import Segment
from motionloom.pipeline.store.artifact import require_consistent
from motionloom.pipeline.store.outside import BUNDLE_FILE, owner_of

if TYPE_CHECKING:
    from motionloom.datasets.audio.sound import Sound

_AT_ONCE = 64
"""Motions sampled together."""

_BEYOND = 0.5
"""Seconds that a motion may be longer than its music."""


class Bundle:
    """The generators of a model, loaded at once so that a broken one is found first, all on one device."""

    def __init__(
        self, stages: Sequence[Finished], shelf: Shelf, recommended: SamplingConfig | None = None
    ) -> None:
        self.stages = tuple(stages)
        """The stages that generate, the default of each kind first."""
        self.shelf = shelf
        self.recommended = recommended or SamplingConfig()
        """How its motions are best drawn; fields that are not set here are nobody's recommendation."""
        self._generators: dict[Path, MotionGenerator] = {}
        self._encoders: dict[Path, PromptEncoder] = {}
        for stage in self.stages:
            self._open(stage)
        parts = [self.of(stage).part for stage in self.stages]
        if all(part == "face" for part in parts):
            raise UserError("no finished stage here generates body motion; run the recipe to the end first")

    @staticmethod
    def open(name: Path | str, device: torch.device = CPU) -> Bundle:
        """Open a run folder, an exported folder, or a model that comes with the package, by its name."""
        folder = model_folder(name)
        if (folder / BUNDLE_FILE).is_file():
            return Bundle._of(folder, open_exported(folder), device, exported_sampling(folder))
        if not (folder / "recipe.yaml").is_file():
            if not folder.exists():
                raise UserError(no_such_model(name))
            said = say_model(name)
            raise UserError(
                f"{folder}: not a run folder (no recipe.yaml) and not an exported one (no {BUNDLE_FILE})"
                + ("" if said is None else "; the model of this name is taken where no such folder is")
            )
        return Bundle.from_run(folder, device)

    @staticmethod
    def from_run(run: Path, device: torch.device = CPU) -> Bundle:
        """Open the finished stages of a run."""
        makers = generators_of(run)
        for stage in makers:
            require_consistent(owner_of(stage.folder), [stage.folder.name])
        return Bundle._of(run, makers, device)

    @staticmethod
    def _of(
        folder: Path,
        stages: Sequence[Finished],
        device: torch.device,
        recommended: SamplingConfig | None = None,
    ) -> Bundle:
        try:
            return Bundle(stages, Shelf(device), recommended)
        except UserError as error:
            if str(error).startswith(str(folder)):
                raise
            raise UserError(f"{folder}: {error}") from None

    def _open(self, stage: Finished) -> None:
        """Load a stage's inputs, and theirs, as far as generation needs them."""
        needed, given = stage.kind.exported(stage.config), self.shelf.given_to(stage)
        for role in stage.kind.roles():
            if role.name in needed and (role.name in given or not role.optional):
                given[role.name]
                self._open(stage.inputs[role.name])

    def of(self, stage: Finished) -> MotionGenerator:
        """The generator that a stage is."""
        if stage.folder not in self._generators:
            self._generators[stage.folder] = self.shelf.generator(stage)
        return self._generators[stage.folder]

    def encoder(self, stage: Finished) -> PromptEncoder:
        """What encodes prompts for a stage."""
        if stage.folder not in self._encoders:
            self._encoders[stage.folder] = PromptEncoder(self.of(stage).text, self.shelf.device)
        return self._encoders[stage.folder]

    @cached_property
    def main(self) -> Finished:
        """The stage that generates body and hands."""
        return next(stage for stage in self.stages if self.of(stage).part != "face")

    @property
    def generator(self) -> MotionGenerator:
        """The generator of body and hands."""
        return self.of(self.main)

    @cached_property
    def faces(self) -> dict[str, Finished]:
        """The stages that generate faces, by method; the first is the default."""
        found = [(self.of(stage), stage) for stage in self.stages]
        out: dict[str, Finished] = {}
        for generator, stage in found:
            if generator.part == "face":
                out.setdefault(generator.method, stage)
        return out

    def choose_face(self, wanted: str | None) -> Finished | None:
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

    @property
    def layout(self) -> MotionLayout:
        """Layout of whole frames."""
        return self.generator.layout

    @property
    def device(self) -> torch.device:
        """Where all networks lie; what is made comes back as numpy arrays."""
        return self.shelf.device

    @property
    def max_seconds(self) -> float:
        """Longest motion; infinite where there is no limit."""
        frames = self.generator.max_frames
        return math.inf if frames is None else frames / self.layout.fps

    def drawing(self, given: SamplingConfig | Mapping[str, Any] | None = None) -> SamplingConfig:
        """How to draw: the fields that are given, else those that the model recommends."""
        named = [config.model_dump(exclude_unset=True) for config in (self.recommended, sampling_of(given))]
        return SamplingConfig.parse({**named[0], **named[1]}, "sampling")

    def generate(
        self,
        captions: Sequence[str] | None = None,
        *,
        face: Sequence[str] | None = None,
        sounds: Sequence[Sound | None] | None = None,
        music: Sequence[NDArray[np.float32] | None] | None = None,
        seconds: float | Sequence[float] | None = None,
        seed: int = 0,
        sampling: SamplingConfig | Mapping[str, Any] | None = None,
        batch: int = _AT_ONCE,
        strict: bool = False,
    ) -> list[GeneratedMotion]:
        """Motions for captions, sounds or both, in order; equal arguments give equal motions.

        A motion's draws go by its place in the list. `seconds` is one length for all or one each; without it
        a motion is as long as its sound, or else the model decides. `music` are the sounds' features [T, 438]
        where they are known, such as those that a data set stores. With `strict`, empty captions and options
        without effect are refused.
        """
        sampling = sampling_of(sampling)
        require_seed(seed)
        texts = None if captions is None else caption_list(captions)
        faces = None if face is None else caption_list(face, "face")
        if strict:
            require_words(faces or [], "face")
            require_used(self, faces, sampling)
        sampling = self.drawing(sampling)
        prompts = prompts_of(texts, faces, sounds, music)
        require_driven(self.generator, prompts)
        frames = self._frames(seconds, prompts)
        # One seed a motion, so that how they are batched plays no part.
        seeds = sample_seeds(seed, 2 * len(prompts))
        out: dict[int, GeneratedMotion] = {}
        for rows in _alike(frames, batch):
            both = [seeds[row] for row in rows], [seeds[len(prompts) + row] for row in rows]
            made = self._batch([prompts[row] for row in rows], [frames[row] for row in rows], both, sampling)
            out.update((row, replace(one, seed=seed)) for row, one in zip(rows, made, strict=True))
        return [out[row] for row in range(len(prompts))]

    def perform(
        self,
        segments: Sequence[DrivenSegment],
        *,
        samples: int = 1,
        seed: int = 0,
        sampling: SamplingConfig | Mapping[str, Any] | None = None,
    ) -> list[GeneratedMotion]:
        """One motion driven by segments of text and music in turn, and other samples of it (`script.py`)."""
        sampling, generator, fps = self.drawing(sampling), self.generator, self.layout.fps
        require_seed(seed)
        if not isinstance(generator, DrivenGenerator):
            raise UserError(
                f"this model ({generator.method}) makes a motion of one prompt; scripts need a UDE model"
            )
        require_driven(generator, [segment.prompt for segment in segments])
        frames = [segment_frames(generator, segment, number) for number, segment in enumerate(segments)]
        seeds = sample_seeds(seed, 2 * samples)
        stretches = [
            Stretch(
                self._repeated(self.main, segment.prompt, segment.prompt.text, samples), [count] * samples
            )
            for segment, count in zip(segments, frames, strict=True)
        ]
        body = generator.drive(stretches, seeds[:samples], sampling)
        faces = self._faces(segments, frames, seeds[samples:], sampling)
        starts = np.concatenate([[0], np.cumsum(frames)]) / fps
        bands = tuple(
            Segment(float(a), float(b), s.label, "text" if s.prompt.sound is None else "music")
            for s, a, b in zip(segments, starts, starts[1:], strict=False)
        )
        sound = sound_of(list(zip(segments, frames, strict=True)), fps)
        words = "; ".join(segment.label for segment in segments)
        return [
            replace(self._motion(Prompt(text=words, sound=sound), motion, face, bands), seed=seed)
            for motion, face in zip(body, faces, strict=True)
        ]

    def _repeated(self, stage: Finished, prompt: Prompt, words: str, count: int) -> Conditions:
        """The conditions of one prompt, encoded once, for `count` rows."""
        once = self.encoder(stage).encode([prompt], [words], self.of(stage).modalities, self.layout.fps)
        return {
            name: Condition(
                features.expand(count, -1, -1),
                mask.expand(count, -1),
                None if pooled is None else pooled.expand(count, -1),
            )
            for name, (features, mask, pooled) in once.items()
        }

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
            conditions = self._repeated(stage, segment.prompt, segment.prompt.words, len(seeds))
            request = GenerationRequest(conditions, [count] * len(seeds), seeds, sampling)
            made.append(self.of(stage).generate(request))
        return [np.concatenate(pieces) for pieces in zip(*made, strict=True)]

    def _motion(
        self,
        prompt: Prompt,
        motion: NDArray[np.float32],
        face: NDArray[np.float32] | None,
        segments: tuple[Segment, ...] = (),
    ) -> GeneratedMotion:
        features, with_it = split_columns(motion, self.generator, self.layout)
        joints = joints_of(features, self.layout)
        expression = with_it if face is None else face
        return GeneratedMotion(prompt, features, joints, expression, self.layout, segments)

    def _batch(
        self,
        prompts: list[Prompt],
        frames: list[int | None],
        seeds: tuple[list[int], list[int]],
        sampling: SamplingConfig,
    ) -> list[GeneratedMotion]:
        generator, layout = self.generator, self.layout
        conditions = self.encoder(self.main).encode(
            prompts, [p.text for p in prompts], generator.modalities, layout.fps
        )
        lengths = None if None in frames else [n for n in frames if n is not None]
        body = generator.generate(GenerationRequest(conditions, lengths, seeds[0], sampling))
        face: list[NDArray[np.float32]] | list[None] = [None] * len(prompts)
        stage = self.choose_face(sampling.face_model)
        if stage is not None:
            maker = self.of(stage)
            words = self.encoder(stage).encode(
                prompts, [p.words for p in prompts], maker.modalities, layout.fps
            )
            # The face takes the body's length, so that both share one time line.
            face = maker.generate(GenerationRequest(words, [len(m) for m in body], seeds[1], sampling))
        return [self._motion(*row) for row in zip(prompts, body, face, strict=True)]

    def _frames(self, seconds: float | Sequence[float] | None, prompts: Sequence[Prompt]) -> list[int | None]:
        """Length of each motion in frames; None where the model decides."""
        fps, unit, most = self.layout.fps, self.generator.unit_frames, self.generator.max_frames
        if seconds is None:
            wanted: list[float | None] = [None if p.sound is None else p.sound.seconds for p in prompts]
        else:
            wanted = list(seconds) if isinstance(seconds, Iterable) else [seconds] * len(prompts)
        if len(wanted) != len(prompts):
            raise UserError(f"{len(prompts)} captions but {len(wanted)} lengths in seconds")
        out: list[int | None] = []
        for length, prompt in zip(wanted, prompts, strict=True):
            if length is None:
                out.append(None)
                continue
            if prompt.sound is not None and prompt.sound.seconds + _BEYOND < length < math.inf:
                raise UserError(
                    f"{length:g} s were asked for and the music lasts {prompt.sound.seconds:.1f} s; take at "
                    f"most as many seconds"
                )
            units = round(length * fps / unit) if math.isfinite(length) else 0
            if units < 1 or (most is not None and units * unit > most):
                longest = "any length from" if most is None else f"{unit / fps:.2g} to"
                end = unit / fps if most is None else self.max_seconds
                raise UserError(f"{length:g} s is out of reach: this model makes {longest} {end:.1f} s")
            out.append(units * unit)
        return out


def split_columns(
    motion: NDArray[np.float32], generator: MotionGenerator, layout: MotionLayout
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Body-hand features and, of a generator that makes all columns, the expression."""
    if generator.part != "all" or not layout.has("face"):
        return motion, None
    return motion[:, layout.part("bodyhand")], motion[:, layout.part("face")]


def _alike(frames: Sequence[int | None], batch: int) -> list[list[int]]:
    """Rows in batches, each all with a given length or all without."""
    free = [row for row, count in enumerate(frames) if count is None]
    given = [row for row, count in enumerate(frames) if count is not None]
    return [rows[i : i + batch] for rows in (free, given) for i in range(0, len(rows), batch)]
