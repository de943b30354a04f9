"""Writing motions for people and tools: npz, BVH, GLB, MP4 and the viewer page."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.features import beats
from motionloom.datasets.base.files import atomic_file
from motionloom.datasets.motion.arkit import ArkitBases, write_arkit_csv
from motionloom.datasets.motion.bvh import write_bvh
from motionloom.datasets.motion.rigid import RigidMotion
from motionloom.datasets.motion.smpl import BodyModel
from motionloom.datasets.motion.smplx_file import write_smplx
from motionloom.datasets.schema import UserError
from motionloom.pipeline.inference.formats import Format
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.shown import FigureOptions, ShownMotion, shown
from motionloom.pipeline.render.body.arkit_face import synthetic_arkit
from motionloom.pipeline.render.body.face import expression_weights
from motionloom.pipeline.render.body.glb import GlbClip, write_glb
from motionloom.pipeline.render.body.mesh import Faces
from motionloom.pipeline.render.face import synthetic_face_controls
from motionloom.pipeline.render.score import Score
from motionloom.pipeline.render.sound import Soundtrack
from motionloom.pipeline.render.video import write_mp4
from motionloom.pipeline.render.viewer import ViewerMotion, write_viewer
from motionloom.pipeline.store.files import require_folder

FaceReader = Callable[[NDArray[Any]], NDArray[np.float64]]
"""Expression values [T, 50] -> weights [T, E] of a face's shapes."""

ALL_GLB = "motions.glb"
"""The file with all motions, each an animation of one figure."""


def file_stem(number: int, caption: str) -> str:
    """A safe file name: number and the first words of the caption."""
    words = re.sub(r"[^a-z0-9]+", "-", caption.lower()).strip("-")[:48].strip("-")
    return f"{number:02d}-{words or 'motion'}"


def write_motions(
    folder: Path,
    motions: Sequence[GeneratedMotion],
    formats: Sequence[Format],
    *,
    title: str,
    note: str = "",
    seed: int,
    scores: Sequence[Score] | None = None,
    figure: FigureOptions | None = None,
    say: Callable[[str], None] | None = None,
) -> list[Path]:
    """Write every motion in every format; the page holds all of them. Returns the paths.

    `title` and `note` are the page's. `scores`, one for each motion: sound for the film and the page, beats
    and segments for the page. Without them each motion comes with what drove it. `figure` says how the shown
    figure follows the generated joints, and `say` is given a line a motion on how far it is from them.
    """
    require_folder(folder)
    scores = [score_of(motion) for motion in motions] if scores is None else scores
    if len(scores) != len(motions):
        raise UserError(f"{len(scores)} scores for {len(motions)} motions; give one for each")
    folder.mkdir(parents=True, exist_ok=True)
    body = None
    if figure is not None and figure.body_model is not None:
        body = BodyModel.load(figure.body_model, "smplx52")
    arkit = _arkit_reader(motions, formats, figure)
    faces: Faces = "expressions" if arkit is None else "arkit"
    out: list[Path] = []
    figures: list[ShownMotion] = []
    for number, (motion, score) in enumerate(zip(motions, scores, strict=True)):
        name = file_stem(number, motion.caption)
        stem = folder / name
        figures.append(shown(motion, figure))
        if say is not None:
            say(f"{name}: {figures[-1].sentence}")
        if "npz" in formats:
            out.append(write_npz(stem.with_suffix(".npz"), figures[-1], seed))
        if "bvh" in formats:
            out.append(write_bvh_of(stem.with_suffix(".bvh"), figures[-1]))
        if "mp4" in formats:
            out.append(stem.with_suffix(".mp4"))
            film(out[-1], figures[-1], score.sound)
        if "glb" in formats:
            out.append(stem.with_suffix(".glb"))
            write_glb(out[-1], [glb_clip(figures[-1], arkit)], faces)
        if arkit is not None and motion.face is not None:
            out.append(folder / f"{name}_arkit.csv")
            write_arkit_csv(out[-1], arkit(motion.face), motion.layout.fps)
        if "smplx" in formats:
            out.append(folder / f"{name}_smplx.npz")
            write_smplx(out[-1], figures[-1].figure, motion.layout.fps, body)
    if "glb" in formats and len(figures) > 1:
        out.append(folder / ALL_GLB)
        write_glb(out[-1], [glb_clip(one, arkit) for one in figures], faces)
    if "html" in formats:
        page = folder / "index.html"
        cells = [viewer_motion(f, "generated", score=s) for f, s in zip(figures, scores, strict=True)]
        write_viewer(page, cells, title, note)
        out.append(page)
    return out


def score_of(motion: GeneratedMotion) -> Score:
    """The music that a motion was driven by, its beats, and the segments; beats only where music drove."""
    sound = motion.prompt.sound
    if sound is None:
        return Score(segments=motion.segments)
    found = [float(time) for time in beats(sound.samples, sound.rate)]
    if motion.segments:
        spans = [(one.start, one.end) for one in motion.segments if one.kind == "music"]
        found = [time for time in found if any(start <= time < end for start, end in spans)]
    return Score(sound=sound, beats=found, segments=motion.segments)


def film(path: Path, figure: ShownMotion, sound: Soundtrack | None = None) -> None:
    """Write the figure's MP4, with its face and with `sound` where there is any."""
    motion = figure.motion
    write_mp4(
        path,
        figure.joints,
        motion.layout.skeleton,
        motion.layout.fps,
        motion.caption,
        sound=sound,
        figure=rigid_of(figure),
        face_controls=None if motion.face is None else synthetic_face_controls(motion.face),
    )


def rigid_of(figure: ShownMotion) -> RigidMotion | None:
    """The rigid figure, where that is what is shown."""
    return figure.figure if figure.joints is figure.figure.joints else None


def viewer_motion(
    motion: GeneratedMotion | ShownMotion, label: str, group: str = "", score: Score | None = None
) -> ViewerMotion:
    """A generated motion's figure as the viewer takes it, with its sound, beats and segments."""
    figure, score = shown(motion), score or Score()
    motion = figure.motion
    return ViewerMotion(
        joints=figure.joints,
        fps=motion.layout.fps,
        parents=motion.layout.skeleton.parents,
        label=label,
        caption=motion.caption,
        group=group,
        face_controls=None if motion.face is None else synthetic_face_controls(motion.face),
        sound=score.sound,
        beats=score.beats,
        segments=score.segments,
        figure=rigid_of(figure),
    )


def _arkit_reader(
    motions: Sequence[GeneratedMotion], formats: Sequence[Format], figure: FigureOptions | None
) -> FaceReader | None:
    """What turns expression values into ARKit weights, where these are wanted."""
    if "arkit" not in formats:
        return None
    if any(motion.face is None for motion in motions):
        raise UserError("this model makes no face: leave the format arkit out")
    if figure is None or figure.arkit_bases is None:
        return synthetic_arkit
    return ArkitBases.read(figure.arkit_bases).weights


def glb_clip(motion: GeneratedMotion | ShownMotion, reader: FaceReader | None = None) -> GlbClip:
    """A generated motion's figure as one animation of a GLB file, with its face.

    `reader` makes the weights of the face's shapes of expression values; without, the synthetic face's.
    """
    figure = shown(motion)
    face = figure.motion.face
    return GlbClip(
        name=figure.motion.caption or "motion",
        figure=figure.figure,
        fps=figure.fps,
        expression=None if face is None else (reader or expression_weights)(face),
        facts=figure.facts(),
    )


def write_glb_of(path: Path, motion: GeneratedMotion | ShownMotion) -> Path:
    """The skinned body, moved by the figure, with its face."""
    write_glb(path, [glb_clip(motion)])
    return path


def write_npz(path: Path, motion: GeneratedMotion | ShownMotion, seed: int | None) -> Path:
    """Joints [T, N, 3] in metres, features, expression, bones, and the facts as one JSON text (no pickle)."""
    figure = shown(motion)
    motion = figure.motion
    facts = {
        "caption": motion.caption,
        "face_caption": motion.face_caption,
        "fps": motion.layout.fps,
        "layout": motion.layout.name,
        "family": motion.layout.family,
        "skeleton": motion.layout.skeleton_name,
        "joint_names": list(motion.layout.skeleton.joints),
        "up": "y",
        "unit": "m",
        "seed": seed,
        "figure": figure.facts(),
    }
    arrays: dict[str, Any] = {
        "joints": figure.joints.astype(np.float32),
        "features": motion.features,
        "rotations": figure.figure.rotations.astype(np.float32),
        "offsets": figure.figure.skeleton.offsets.astype(np.float32),
        "root": figure.figure.root.astype(np.float32),
    }
    if motion.face is not None:
        arrays["face"] = motion.face
    with atomic_file(path) as file:
        np.savez_compressed(file, metadata=np.array(json.dumps(facts)), **arrays)
    return path


def write_bvh_of(path: Path, motion: GeneratedMotion | ShownMotion) -> Path:
    """The figure's bones and rotations."""
    figure = shown(motion)
    fitted = figure.figure
    write_bvh(path, fitted.skeleton, fitted.rotations, fitted.root, figure.fps)
    return path
