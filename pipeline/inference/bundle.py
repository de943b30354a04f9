"""A trained model ready to generate: a generator of body and hands, and one of the face where there is one.

A bundle opens from a run folder or from an exported one; both hold one folder a stage, and each stage loads
itself (`contract/stage.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.contract.generation import MotionGenerator, Prompt
from motionloom.pipeline.contract.lookup import captioners_of, exported_sampling, generators_of, open_exported
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import CAPTIONER, CPU, CompletedStage, StageCache
from motionloom.pipeline.inference.shipped_models import find_model
from motionloom.pipeline.store.artifact import Terms, require_consistent
from motionloom.pipeline.store.run_folder import BUNDLE_FILE, hint_at, owner_of

if TYPE_CHECKING:
    from motionloom.pipeline.contract.captioning import MotionCaptioner
    from motionloom.pipeline.inference.motion import GeneratedMotion
    from motionloom.pipeline.store.known_captions import Unknown


class NoBodyError(UserError):
    """No stage of a bundle generates body motion."""

    def __init__(self) -> None:
        super().__init__("no finished stage here generates body motion; run the recipe to the end first")


class Bundle:
    """The generators of a model, loaded at once so that a broken one is found first, all on one device."""

    def __init__(
        self,
        stages: Sequence[CompletedStage],
        stage_cache: StageCache,
        recommended: SamplingConfig | None = None,
        captioners: Callable[[], Sequence[CompletedStage]] = tuple,
    ) -> None:
        self.stages = tuple(stages)
        """The stages that generate, the default of each kind first."""
        self._find_captioners = captioners
        self.stage_cache = stage_cache
        self.recommended = recommended or SamplingConfig()
        """Recommended sampling settings; fields that are not set have no recommendation."""
        self._generators: dict[Path, MotionGenerator] = {}
        for stage in self.stages:
            self._open(stage)
        if {self.generator_of(stage).part for stage in self.stages} <= {"face"} and not self.captioners:
            raise NoBodyError

    @cached_property
    def captioners(self) -> tuple[CompletedStage, ...]:
        """The stages that caption motions, loaded when somebody asks for them."""
        found = tuple(self._find_captioners())
        for stage in found:
            self._open(stage)
        return found

    @cached_property
    def terms(self) -> Terms:
        """Licences and credits of all data that it was made from."""
        return Terms.of(stage.folder for stage in (*self.stages, *self.captioners))

    @staticmethod
    def open(name: Path | str, device: torch.device = CPU) -> Bundle:
        """Open a run folder, an exported folder, a model that comes with the package, or one of the hub."""
        folder = find_model(name)
        if (folder / BUNDLE_FILE).is_file():
            captioners = partial(open_exported, folder, CAPTIONER)
            return Bundle._in(folder, open_exported(folder), device, exported_sampling(folder), captioners)
        if not (folder / "recipe.yaml").is_file():
            raise UserError(
                f"{folder}: not a run folder (no recipe.yaml) and not an exported one (no {BUNDLE_FILE})"
            )
        return Bundle.from_run(folder, device)

    @staticmethod
    def from_run(run: Path, device: torch.device = CPU) -> Bundle:
        return Bundle._in(
            run, _consistent(generators_of(run)), device, None, lambda: _consistent(captioners_of(run))
        )

    @staticmethod
    def _in(
        folder: Path,
        stages: Sequence[CompletedStage],
        device: torch.device,
        recommended: SamplingConfig | None,
        captioners: Callable[[], Sequence[CompletedStage]],
    ) -> Bundle:
        """The bundle of a folder's stages; what is wrong with it names the folder."""
        try:
            return Bundle(stages, StageCache(device), recommended, captioners)
        except NoBodyError as error:
            raise UserError(f"{folder}: {error}{hint_at(folder)}") from None
        except UserError as error:
            if str(error).startswith(str(folder)):  # it says more nearly where
                raise
            raise UserError(f"{folder}: {error}") from None

    def _open(self, stage: CompletedStage) -> None:
        """Load a stage's inputs, and theirs, as far as generation needs them."""
        needed = stage.kind.exported(stage.config)
        inputs = self.stage_cache.given(stage.inputs)
        for role in stage.kind.roles():
            if role.name in needed and (role.name in inputs or not role.optional):
                inputs[role.name]  # looking it up loads it, so a broken one is found before anything is made
                self._open(stage.inputs[role.name])

    def generator_of(self, stage: CompletedStage) -> MotionGenerator:
        """The generator of a stage that generates."""
        if stage.folder not in self._generators:
            self._generators[stage.folder] = self.stage_cache.generator(stage)
        return self._generators[stage.folder]

    @cached_property
    def main(self) -> CompletedStage:
        """The stage that generates body and hands."""
        for stage in self.stages:
            if self.generator_of(stage).part != "face":
                return stage
        raise NoBodyError

    @property
    def generator(self) -> MotionGenerator:
        return self.generator_of(self.main)

    @cached_property
    def faces(self) -> dict[str, CompletedStage]:
        """The stages that generate faces, by method; the first is the default."""
        out: dict[str, CompletedStage] = {}
        for stage in self.stages:
            if self.generator_of(stage).part == "face":
                out.setdefault(self.generator_of(stage).method, stage)
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

    def require_used(self, sampling: SamplingConfig, prompts: Iterable[Prompt] = ()) -> None:
        """Refuse settings and face captions that were given, and that no generator in use takes notice of."""
        from motionloom.pipeline.inference.request import require_used

        stage = self.choose_face(sampling.face_model)
        faces = {method: self.generator_of(one) for method, one in self.faces.items()}
        face = None if stage is None else self.generator_of(stage)
        require_used(self.generator, faces, face, sampling, prompts)

    def drawing(self, sampling: SamplingConfig | None = None) -> SamplingConfig:
        """Return the sampling settings, unset fields as the model recommends."""
        return self.recommended if sampling is None else sampling.over(self.recommended)

    def in_effect(self, sampling: SamplingConfig | None = None) -> dict[str, object]:
        """The settings that motions are drawn with, of those that the generators in use take notice of."""
        sampling = self.drawing(sampling)
        face = self.choose_face(sampling.face_model)
        used = [self.generator, *([] if face is None else [self.generator_of(face)])]
        noticed = frozenset[str]().union(*(generator.settings for generator in used))
        out: dict[str, object] = {name: value for name, value in sampling.dump().items() if name in noticed}
        for generator, prefix in zip(used, ("", "face_"), strict=False):
            if (denoising := generator.capabilities.denoising) is not None:
                sampler, steps = denoising(sampling)
                out |= {f"{prefix}sampler": sampler, f"{prefix}denoising_steps": steps}
        return {name: value for name, value in out.items() if value not in (None, {})}

    def unknown_captions(
        self, captions: Sequence[str], face: Sequence[str] = (), face_model: str | None = None
    ) -> list[Unknown]:
        """Return captions unlike all that were trained on; none where a model does not say what it knows."""
        from motionloom.pipeline.inference.checks import unknown_captions

        out: list[Unknown] = []
        for stage, texts in ((self.main, captions), (self.choose_face(face_model), face)):
            source = None if stage is None else self.generator_of(stage).prepared.get("text")
            out += unknown_captions(source, texts, face=texts is face)
        return out

    def notes(
        self,
        prompts: Sequence[Prompt],
        motions: Sequence[GeneratedMotion] = (),
        face_model: str | None = None,
        lengths: Sequence[float | None] = (),
    ) -> list[Unknown | str]:
        """Return the notes on prompts, and on motions whose length is not the one asked for, in seconds."""
        from motionloom.pipeline.inference.checks import rounded_lengths, standing

        texts = [prompt.text for prompt in prompts]
        faces = [prompt.face_text for prompt in prompts]
        remarks = dict.fromkeys(prompt.remark for prompt in prompts if prompt.remark)
        shown = [*rounded_lengths(self.generator, lengths, motions), *standing(motions)]
        shown += self.find_mismatches(motions)
        return [*self.unknown_captions(texts, faces, face_model), *remarks, *shown]

    def find_mismatches(self, motions: Iterable[GeneratedMotion]) -> list[str]:
        """Return a sentence for each caption, scripts apart, of which its motions show something else."""
        from motionloom.pipeline.inference.checks import find_mismatches

        source = self.generator.prepared.get("text")
        single = ((motion.caption, motion.joints) for motion in motions if not motion.segments)
        return find_mismatches(source, single, self.layout.fps)


def _consistent(stages: Sequence[CompletedStage]) -> Sequence[CompletedStage]:
    """The stages, each made of what its run holds now."""
    for stage in stages:
        require_consistent(owner_of(stage.folder), [stage.folder.name])
    return stages
