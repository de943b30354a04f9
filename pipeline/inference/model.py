"""`MotionModel`: a trained model in one folder, saved, loaded and shared through the hub.

    model = MotionModel.from_pretrained("synthetic")       # a model of the package, a folder, or a hub's name
    motions = model.generate(["a person waves"], seed=1)
    motions[0].joints                                      # [T, N, 3] metres

The folder holds weights (safetensors), configs, statistics, the skeleton and, where it does not come with the
installation, the text encoder: nothing else is needed, and nothing in it is ever unpickled or run.
"""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import torch

from motionloom.pipeline.contract.ability import ability_of
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.shipped_models import find_model
from motionloom.pipeline.launch.hardware import choose_device, threads_for
from motionloom.pipeline.store.run_folder import BUNDLE_FILE
from motionloom.pipeline.store.text import TextSource
from motionloom.pipeline.store.weights import MODEL_FILES

if TYPE_CHECKING:
    from motionloom.datasets.audio.sound import Sound
    from motionloom.pipeline.inference.motion import GeneratedMotion
    from motionloom.pipeline.inference.request import Columns, Request
    from motionloom.pipeline.inference.script import Script
    from motionloom.pipeline.store.known_captions import Unknown

Sampling = SamplingConfig | Mapping[str, object]
"""Settings, or a mapping like `{"top_p": 0.9}`."""


class MotionModel:
    """Captions, music or both to whole-body motions."""

    def __init__(self, folder: Path | str, device: str | torch.device = "auto") -> None:
        self.folder = find_model(folder)
        with threads_for(1):  # tensors by the hundred, none of which several threads read sooner
            self.bundle = Bundle.open(self.folder, choose_device(device))

    def __repr__(self) -> str:
        stages = (*self.bundle.stages, *self.bundle.captioners)
        makers = ", ".join(f"{stage.name} ({stage.kind.name})" for stage in stages)
        layout = self.bundle.layout
        return f"MotionModel({str(self.folder)!r}: {makers}; {layout.name}, {layout.fps:g} frames/s)"

    @classmethod
    def from_pretrained(cls, pretrained_model_name_or_path: str | Path, **options: Any) -> MotionModel:
        """A folder, a model that comes with the package, or a name on the hub (`owner/name`).

        `options` are `device` (auto: a GPU if there is one; cpu, cuda, cuda:N) and the hub's (revision,
        token, local_files_only). Raises `UserError` where there is no such model.
        """
        device = options.pop("device", "auto")
        return cls(find_model(pretrained_model_name_or_path, **options), device)

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
        sampling: Sampling | None = None,
        seed_motion: Path | str | Columns | Sequence[Columns] | None = None,
    ) -> list[GeneratedMotion]:
        """Motions for captions, sounds or both, in order; equal arguments give equal motions.

        A motion's draws go by its place in the list. `seconds` is one length for all or one each; without it
        a motion is as long as its sound, or else the model decides. To silence it stands, or does what the
        words say, and it warns, as of a sound with hardly a beat. An option that this model takes no notice
        of is refused; of a caption that is far from all it was trained on, it warns. What `sampling` leaves
        out is as the model's export recommends, or the default. `seed_motion` is for models that go on from a
        motion, with whose last frames theirs begin: a file (.npz, .bvh, .glb), or the layout's columns [T,
        D], for all or one for each; without it they take the start of a training dance. `conditions` are more
        of what motions are conditioned on, by modality: of "audio" the sounds' features [T, 438], where they
        are known, such as those that a data set stores. `noise_seed` decodes the same tokens with other
        noise, where a diffusion model decodes.
        """
        from motionloom.pipeline.inference.request import Request, require_words

        request = Request.of(
            captions, face=face, sounds=sounds, conditions=conditions, seconds=seconds, seed=seed,
            noise_seed=noise_seed, sampling=sampling, seed_motions=seed_motion,
        )  # fmt: skip
        require_words(face or (), "face")
        return self._told(request)

    def perform(
        self,
        script: Path | str | Script,
        *,
        samples: int = 1,
        seed: int = 0,
        sampling: Sampling | None = None,
    ) -> list[GeneratedMotion]:
        """One motion driven by a script of text and music in turn, and `samples` - 1 others of it.

        `script` is a file, or a `Script` whose sound files are seen from the current folder.
        """
        from motionloom.pipeline.inference.request import Request

        return self._told(Request.of_script(script, samples=samples, seed=seed, sampling=sampling))

    def _told(self, request: Request) -> list[GeneratedMotion]:
        """The motions of a request, with warnings about them."""
        motions = self.make(request)
        for note in self.notes(request, motions):
            warnings.warn(str(note), stacklevel=3)
        return motions

    def make(self, request: Request) -> list[GeneratedMotion]:
        """The motions of a request, without a word about them; options without effect are refused."""
        from motionloom.pipeline.inference.generation import generate

        self.bundle.require_used(request.sampling, request.prompts)
        with self.threads(request.count):
            return generate(self.bundle, request)

    def notes(self, request: Request, motions: Sequence[GeneratedMotion]) -> list[Unknown | str]:
        """What a person should know of these motions of a request."""
        face_model = request.sampling.face_model
        return self.bundle.notes(request.prompts, motions, face_model, request.lengths)

    def threads(self, motions: int) -> AbstractContextManager[None]:
        """As many threads as so many motions at once can use."""
        files = (stage.folder / MODEL_FILES[0] for stage in self.bundle.stages)
        return threads_for(motions, sum(path.stat().st_size for path in files if path.is_file()))

    def examples(self, count: int = 6) -> list[str]:
        """Some captions that it knows, unlike each other; none where it does not say what it knows."""
        text = self.bundle.generator.prepared.get("text")
        known = text.known.get("body") if isinstance(text, TextSource) else None
        return list(known.captions[:count]) if known else []

    def unknown(self, captions: Sequence[str], face: Sequence[str] = ()) -> list[Unknown]:
        """Captions that are far from all that it was trained on, and what it knows nearest to each."""
        from motionloom.pipeline.inference.request import caption_list

        return self.bundle.unknown_captions(caption_list(captions), caption_list(face, "face"))

    def ability(self, name: str) -> Callable[..., Any]:
        """What a package has added to models, such as "edit". `UserError` where this one cannot do it."""
        return partial(ability_of(self.bundle.generator, name), self)

    def edit(
        self,
        clip: Path | str | GeneratedMotion,
        task: object,
        *,
        samples: int = 1,
        seed: int = 0,
        sampling: Sampling | None = None,
    ) -> list[Any]:
        """A clip of which a part is made anew, `samples` times: `EditedMotion`s of `pipeline/editing`.

        Args:
            clip: A file (BVH, or the npz or GLB of a motion), or a generated motion.
            task: What to keep and what to ask of the rest: an `EditTask`, or a mapping of its keys.
            seed: Equal arguments give equal motions.
            sampling: As of `generate`.

        Only models whose body is made by diffusion edit. Each result says how near it is to its task
        (`report`).
        """
        return list(self.ability("edit")(clip, task, samples=samples, seed=seed, sampling=sampling))

    @property
    def fps(self) -> float:
        return self.bundle.layout.fps

    @property
    def modalities(self) -> frozenset[str]:
        """Modalities of its conditions: "text", "audio" or both."""
        return self.bundle.generator.modalities

    @property
    def max_seconds(self) -> float:
        """Its longest motion; infinite where there is no limit."""
        return self.bundle.max_seconds

    def save_pretrained(self, save_directory: Path | str) -> None:
        """Copy all that `generate` needs into a folder, new or one that holds an earlier copy."""
        from motionloom.pipeline.inference.exported import write_bundle

        if (self.folder / BUNDLE_FILE).is_file():
            shutil.copytree(self.folder, save_directory, dirs_exist_ok=True)
        else:
            write_bundle(self.folder, Path(save_directory))

    def push_to_hub(
        self, repo_id: str, *, private: bool | None = None, token: str | None = None, **options: Any
    ) -> str:
        """Save it as a model of the hub, `owner/name`; returns the commit's address.

        `options` are of huggingface_hub's `upload_folder`: commit_message, revision, create_pr and more.
        """
        from huggingface_hub import HfApi

        api = HfApi(token=token)
        name = api.create_repo(repo_id, private=private, exist_ok=True).repo_id
        with TemporaryDirectory(prefix="motionloom-") as folder:
            self.save_pretrained(folder)
            return str(api.upload_folder(repo_id=name, folder_path=folder, **options))
