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
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from huggingface_hub import ModelHubMixin
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.body.rigid import RigidMotion
from motionloom.datasets.motion.bvh.own_file import between_rows
from motionloom.datasets.motion.layout import PIECES, piece_joints
from motionloom.models.layers.seeds import sample_seeds
from motionloom.pipeline.contract.editing import EditTask
from motionloom.pipeline.contract.generation import Prompt
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.edits.clip_file import (
    changed,
    features_for,
    read_clip,
    read_seed_motion,
    require_clip,
)
from motionloom.pipeline.inference.edits.edit import finish, own_bvh, own_figure, report_of, require_editor
from motionloom.pipeline.inference.edits.frames import EditFrames, edit_frames, require_work
from motionloom.pipeline.inference.edits.recorded import RecordedClip
from motionloom.pipeline.inference.exported import HUB_CONFIG, write_bundle
from motionloom.pipeline.inference.motion import EditedMotion, GeneratedMotion
from motionloom.pipeline.inference.requests import (
    caption_list,
    lengths_of,
    require_samples,
    require_seed,
    sound_list,
    weight_bytes,
)
from motionloom.pipeline.inference.script import Script
from motionloom.pipeline.inference.shipped_models import find_model
from motionloom.pipeline.inference.shown import shown
from motionloom.pipeline.launch.hardware import choose_device, threads_for
from motionloom.pipeline.store.known_captions import Unknown
from motionloom.pipeline.store.run_folder import BUNDLE_FILE
from motionloom.pipeline.store.text import TextSource

if TYPE_CHECKING:
    from motionloom.datasets.audio.sound import Sound


class MotionModel(
    ModelHubMixin,
    library_name="motionloom",
    pipeline_tag="text-to-3d",
    tags=["human-motion", "text-to-motion", "whole-body"],
):
    """Captions, music or both to whole-body motions."""

    def __init__(self, folder: Path | str, device: str | torch.device = "auto") -> None:
        self.folder = find_model(folder)
        self.bundle = Bundle.open(self.folder, choose_device(device))
        # The mixin would write our argument, a local path, into the config.json that the hub wants.
        self._hub_mixin_config = dict(HUB_CONFIG)

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
        seconds: float | Sequence[float | None] | None = None,
        seed: int = 0,
        sampling: SamplingConfig | Mapping[str, object] | None = None,
        seed_motion: Path | str | NDArray[np.float32] | None = None,
    ) -> list[GeneratedMotion]:
        """Motions for captions, sounds or both, in order; equal arguments give equal motions.

        A motion's draws go by its place in the list. `seconds` is one length for all or one each; without it
        a motion is as long as its sound, or else the model decides. To silence it stands, or does what the
        words say, and it warns, as of a sound with hardly a beat. `sampling` is a `SamplingConfig` or a
        mapping like `{"top_p": 0.9}`. An option that this model takes no notice of is refused; of a caption
        that is far from all it was trained on, it warns. What `sampling` leaves out is as the model's export
        recommends, or the default. `seed_motion` is for models that go on from a motion, with whose last
        frames theirs begin: a file (.npz, .bvh, .glb), or the layout's columns [T, D]; without it they take
        the start of a training dance.
        """
        captions = None if captions is None else caption_list(captions)
        sounds = None if sounds is None else sound_list(sounds)
        seconds = lengths_of(seconds)
        if isinstance(seed_motion, Path | str):
            seed_motion = read_seed_motion(Path(seed_motion), self.bundle.layout)
        with threads_for(len(sounds or captions or ()), weight_bytes(self.bundle.stages)):
            motions = self.bundle.generate(
                captions, face=face, sounds=sounds, seconds=seconds, seed=seed,
                sampling=SamplingConfig.of(sampling), strict=True,
                seed_motions=None if seed_motion is None else [seed_motion],
            )  # fmt: skip
        for note in self.bundle.notes([motion.prompt for motion in motions], motions, seconds=seconds):
            warnings.warn(str(note), stacklevel=2)
        return motions

    def examples(self, count: int = 6) -> list[str]:
        """Some captions that it knows, unlike each other; none where it does not say what it knows."""
        text = self.bundle.generator.prepared.get("text")
        known = text.known.get("body") if isinstance(text, TextSource) else None
        return list(known.captions[:count]) if known else []

    def unknown(self, captions: Sequence[str], face: Sequence[str] = ()) -> list[Unknown]:
        """Captions that are far from all that it was trained on, and what it knows nearest to each."""
        return self.bundle.unknown_captions(caption_list(captions), caption_list(face, "face"))

    def perform(
        self,
        script: Path | str | Script,
        *,
        samples: int = 1,
        seed: int = 0,
        sampling: SamplingConfig | Mapping[str, object] | None = None,
    ) -> list[GeneratedMotion]:
        """One motion driven by a script of text and music in turn, and `samples` - 1 others of it.

        `script` is a file, or a `Script` whose sound files are seen from the current folder.
        """
        segments = script.open() if isinstance(script, Script) else Script.read(Path(script))
        drawn = SamplingConfig.of(sampling)
        motions = self.bundle.perform(segments, samples=samples, seed=seed, sampling=drawn)
        for note in self.bundle.notes([segment.prompt for segment in segments]):
            warnings.warn(str(note), stacklevel=2)
        return motions

    def edit(
        self,
        clip: Path | str | GeneratedMotion,
        task: EditTask | Mapping[str, object],
        *,
        samples: int = 1,
        seed: int = 0,
        sampling: SamplingConfig | Mapping[str, object] | None = None,
    ) -> list[EditedMotion]:
        """A clip of which a part is made anew, `samples` times.

        Args:
            clip: A file (BVH, or the npz or GLB of a motion), or a generated motion.
            task: What to keep and what to ask of the rest: an `EditTask`, or a mapping of its keys.
            seed: Equal arguments give equal motions.
            sampling: As of `generate`.

        Only models whose body is made by diffusion edit. Each result says how near it is to its task
        (`EditedMotion.report`).
        """
        require_editor(self.bundle.generator)
        asked = EditTask.parse(task, "task")
        if isinstance(clip, GeneratedMotion):
            figure = shown(clip).figure
            facts = (clip.fps, clip.face, clip.caption, clip.bvh, figure)
            recorded = require_clip(RecordedClip("the motion", figure.joints, *facts))
        else:
            recorded = read_clip(Path(clip))
        with threads_for(samples, weight_bytes(self.bundle.stages)):
            return edit_clip(
                self.bundle, recorded, asked, samples=samples, seed=seed, sampling=SamplingConfig.of(sampling)
            )

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

    def _save_pretrained(self, save_directory: Path) -> None:
        """Copy all that `generate` needs into the folder."""
        if (self.folder / BUNDLE_FILE).is_file():
            shutil.copytree(self.folder, save_directory, dirs_exist_ok=True)
        else:
            write_bundle(self.folder, save_directory)


def edit_clip(
    bundle: Bundle, clip: RecordedClip, task: EditTask, *, samples: int, seed: int, sampling: SamplingConfig
) -> list[EditedMotion]:
    """Edit a clip as `MotionModel.edit`."""
    require_seed(seed)
    require_samples(samples)
    layout, sampling = bundle.layout, bundle.drawing(sampling)
    require_work(task, clip, layout)
    if task.changes_clip:
        before = edit_frames(EditTask(), clip, layout)
        frames = edit_frames(task, changed(clip, task), layout)
    else:
        before = frames = edit_frames(task, clip, layout)
    editor, generator = require_editor(bundle.generator), bundle.generator
    prompt, original = Prompt(task.caption), original_of(before, clip)
    words = bundle.encode(bundle.main, [prompt], [prompt.text]) if prompt.text.strip() else {}
    columns = layout.part(generator.part)
    whole = np.repeat(frames.features[None], samples, axis=0)
    whole[..., columns] = np.stack(editor(frames, words, sample_seeds(seed, samples), sampling))
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
        bvh, fps = None, layout.fps
        if clip.bvh is not None:
            try:
                bvh = own_bvh(clip.bvh, frames, figure)
            except UserError as error:
                notes.append(f"a BVH of this has a skeleton of ours, not the clip's: {error}")
        elif frames.drawn and not task.changes_clip:
            figure, fps = own_figure(clip, frames, figure), clip.fps
        # What is said is of the joints that a file holds.
        rounded = figure.joints.astype(np.float32) + np.array([0, frames.base, 0])
        rate = fps if bvh is None else bvh.motion.fps
        joints = frames.of_file(rounded if bvh is None else bvh.places(), rate)
        if words and frames.pieces[:, : PIECES.index("left_hand")].all():
            made_anew = ~frames.pieces[frames.inside][:, piece_joints(layout)[: joints.shape[1]]]
            if joints.shape == frames.seen.shape and made_anew.any():
                moved = np.linalg.norm(joints - frames.seen, axis=-1)[made_anew].mean()
                notes.append(f"hands alone are made anew: by {100 * moved:.1f} cm on average")
        edited = EditedMotion(
            prompt, features, figure.joints, face, layout, seed=seed, original=original, bvh=bvh,
            report=report_of(frames, joints, heading, rate), remarks=(*frames.remarks, *notes),
        )  # fmt: skip
        out.append(_drawn(edited, figure, fps))
    return out


def original_of(frames: EditFrames, clip: RecordedClip) -> GeneratedMotion:
    """The clip of a task: a figure of ours as it is, others as the model reads them."""
    layout, figure = frames.layout, frames.to_world(frames.figure)
    features = frames.features[frames.inside][:, layout.part("bodyhand")]
    motion = GeneratedMotion(Prompt(clip.caption), features, figure.joints, frames.face, layout, bvh=clip.bvh)
    if frames.drawn and clip.figure is not None and clip.bvh is None:
        return _drawn(motion, clip.figure, clip.fps)
    return _drawn(motion, figure, layout.fps)


Drawn = TypeVar("Drawn", bound=GeneratedMotion)


def _drawn(motion: Drawn, figure: RigidMotion, fps: float) -> Drawn:
    """The motion with the figure that is shown of it, at the frame rate of that."""
    joints, face, layout = figure.joints, motion.face, replace(motion.layout, fps=fps)
    if fps == motion.fps:
        return replace(motion, figure=figure, joints=joints)
    if face is not None:
        at = np.arange(len(joints)) / fps * motion.fps
        face = between_rows(face[..., None], at.clip(0, len(face) - 1))[..., 0].astype(np.float32)
    features = features_for(joints, fps, layout.without_face())[0]
    return replace(motion, figure=figure, joints=joints, face=face, features=features, layout=layout)
