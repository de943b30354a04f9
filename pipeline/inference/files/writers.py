"""The files that motions can be written as: one `Writer` a format, all of them in `WRITERS`.

A new format is one function and its `Writer`, registered: `generate --format`, the `generate` stage,
`GeneratedMotion.save`, the help of the command line and the server take it from there.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AfterValidator

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.register import Table, discover, register

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from motionloom.pipeline.inference.files.display_figure import FigureOptions, ShownMotion
    from motionloom.pipeline.render.body.glb import GlbClip
    from motionloom.pipeline.render.sound import Score
    from motionloom.pipeline.render.viewer import ViewerMotion


@dataclass(frozen=True)
class OutputClip:
    """One motion to write."""

    shown: ShownMotion
    score: Score
    options: FigureOptions
    label: str = "generated"
    """Heading of its figure on the page."""
    arkit: bool = False
    """Whether GLB files carry ARKit's 52 shapes of the face, instead of the synthetic source's own."""
    notes: Sequence[object] = ()
    """Lines under its figure on the page."""

    @property
    def name(self) -> str:
        """What its animation is called: the caption; without one, as a dance or an edit is, its heading."""
        return self.shown.motion.words or self.label

    @cached_property
    def face(self) -> NDArray[np.float32] | None:
        """Expression values [T, 50]."""
        return self.shown.motion.face

    @cached_property
    def controls(self) -> NDArray[np.float64] | None:
        """Controls of the drawn face [T, 5]."""
        from motionloom.pipeline.render.body.face import synthetic_face_controls

        return None if self.face is None else synthetic_face_controls(self.face)

    def arkit_weights(self) -> NDArray[np.float64]:
        """Weights of ARKit's shapes [T, 52], by the user's bases where there are any."""
        from motionloom.pipeline.render.body.face import ArkitBases
        from motionloom.pipeline.render.body.mesh import synthetic_arkit

        if self.face is None:
            raise UserError("this model makes no face: leave the format arkit out")
        if self.options.arkit_bases is None:
            return synthetic_arkit(self.face)
        return ArkitBases.read(self.options.arkit_bases).weights(self.face)


@dataclass(frozen=True)
class Outputs:
    """Motions that are written together, and what their page is called."""

    clips: Sequence[OutputClip]
    title: str = ""
    note: str = ""


@dataclass(frozen=True)
class Writer:
    """One format."""

    name: str
    """In `--format`, in the `formats` of a recipe's `generate` stage and in the server's API."""
    suffix: str
    """Suffix behind the name of a motion: `.npz`, `_smplx.npz`. `GeneratedMotion.save` goes by it."""
    mime: str
    """Media type, for the server's answers."""
    help: str
    """A few words for the help of `--format`."""
    write: Callable[[Path, Outputs], Sequence[str] | None] = field(repr=False)
    """Writes the clips to the path; a single one, unless it is the file `together`. `clip.shown.joints` are
    [T, N, 3] in metres, Y up. Returns sentences on what the file could not take, if any. Raises `UserError`
    for motions that the format cannot hold."""
    together: str = ""
    """Name of the file that holds all motions; empty where each has only its own."""
    alone: bool = True
    """Whether each motion has a file of its own."""
    default: bool = False
    """Whether it is written where nobody names formats."""
    options: Mapping[str, str] = field(default_factory=dict)
    """Options that it alone takes (`--set`), with a few words on each; they come in `clip.options.more`."""
    needs_face: bool = False
    """Left out of what a server offers for motions without a face."""


def write_npz(path: Path, outputs: Outputs) -> None:
    """Joints [T, N, 3] in metres, features, expression, bones, and the facts as one JSON text (no pickle)."""
    import numpy as np

    from motionloom.datasets.base.files import atomic_file

    [clip] = outputs.clips
    figure = clip.shown
    motion = clip.shown.motion
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
        "seed": motion.seed,
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


def write_bvh(path: Path, outputs: Outputs) -> None:
    """The user's own file, where the motion is of one; else the figure's bones and rotations."""
    from motionloom.datasets.base.files import write_bytes
    from motionloom.datasets.motion.bvh.motion import write_bvh as write

    [clip] = outputs.clips
    figure = clip.shown.figure
    if (own := clip.shown.motion.bvh) is not None:
        write_bytes(path, own.file)
        return
    write(path, figure.skeleton, figure.rotations, figure.root, clip.shown.fps)


def write_html(path: Path, outputs: Outputs) -> None:
    """The viewer page with all motions."""
    from motionloom.pipeline.render.viewer import write_viewer

    write_viewer(path, [cell_of(clip, clip.label) for clip in outputs.clips], outputs.title, outputs.note)


def write_glb(path: Path, outputs: Outputs) -> None:
    """The skinned body, each motion an animation of it, with its face."""
    from motionloom.pipeline.render.body.glb import write_glb as write

    arkit = outputs.clips[0].arkit
    write(path, [_animation(clip) for clip in outputs.clips], "arkit" if arkit else "expressions")


def _animation(clip: OutputClip) -> GlbClip:
    from motionloom.pipeline.render.body.face import expression_weights
    from motionloom.pipeline.render.body.glb import GlbClip

    face = None
    if clip.face is not None:
        face = clip.arkit_weights() if clip.arkit else expression_weights(clip.face)
    return GlbClip(clip.name, clip.shown.figure, clip.shown.fps, face, clip.shown.facts())


def write_smplx(path: Path, outputs: Outputs) -> None:
    """Parameters of SMPL-X, made for the user's body model where there is one."""
    from motionloom.datasets.motion.body.smpl import BodyModel
    from motionloom.datasets.motion.body.smplx_file import write_smplx as write

    [clip] = outputs.clips
    model = clip.options.body_model
    write(
        path, clip.shown.figure, clip.shown.fps, None if model is None else BodyModel.load(model, "smplx52")
    )


def write_arkit(path: Path, outputs: Outputs) -> None:
    """ARKit's 52 weights of each frame."""
    from motionloom.pipeline.render.body.face import write_arkit_csv

    [clip] = outputs.clips
    write_arkit_csv(path, clip.arkit_weights(), clip.shown.fps)


def cell_of(clip: OutputClip, label: str = "generated") -> ViewerMotion:
    """The motion as the viewer takes it, with its sound, beats and segments."""
    from motionloom.pipeline.render.viewer import ViewerMotion

    motion = clip.shown.motion
    remark = "" if motion.segments else motion.prompt.remark
    return ViewerMotion(
        joints=clip.shown.joints,
        fps=clip.shown.fps,
        parents=motion.layout.skeleton.parents,
        label=label,
        caption=motion.words,
        face_controls=clip.controls,
        sound=clip.score.sound,
        beats=clip.score.beats,
        segments=clip.score.segments,
        figure=clip.shown.figure,
        note="\n".join(dict.fromkeys(filter(None, (remark, *map(str, clip.notes))))),
    )


_BYTES = "application/octet-stream"
WRITERS: Table[Writer] = Table(Writer, "writer")
"""By the names that `--format` knows."""
for _writer in (
    Writer("npz", ".npz", _BYTES, "joints and features as numpy arrays", write_npz, default=True),
    Writer("bvh", ".bvh", "text/plain; charset=utf-8", "bones for animation tools", write_bvh),
    Writer("glb", ".glb", "model/gltf-binary", "the skinned body for 3-D tools", write_glb, "motions.glb"),
    Writer("smplx", "_smplx.npz", _BYTES, "SMPL-X parameters", write_smplx),
    Writer(
        "arkit", "_arkit.csv", "text/csv; charset=utf-8", "the face for ARKit", write_arkit, needs_face=True
    ),
    Writer(
        "html", ".html", "text/html; charset=utf-8", "a page to watch", write_html, "index.html", False,
        default=True,
    ),
):  # fmt: skip
    register(_writer)


def default_formats(options: Collection[str] = ()) -> list[str]:
    """The default formats, and those that take one of these options."""
    return [name for name, writer in WRITERS.items() if writer.default or {*writer.options} & {*options}]


def formats_help() -> str:
    """The formats in one sentence of a command's help."""
    names = []
    for name, writer in WRITERS.items():
        options = "".join(f"; --set {option}: {words}" for option, words in writer.options.items() if words)
        names.append(f"{name} ({writer.help}{options})")
    return f"Comma-separated, default {','.join(default_formats())}: {', '.join(names)}."


_MADE_BY = {"body_model": ["smplx"], "arkit_bases": ["arkit"]}


def figure_keys() -> list[str]:
    """Keys of `FigureOptions`, and options of formats."""
    from motionloom.pipeline.inference.files.display_figure import FigureOptions

    own = [key for key in FigureOptions.model_fields if key != "more"]
    return [*own, *(option for writer in WRITERS.values() for option in writer.options)]


def figure_options(values: Mapping[str, object], formats: Sequence[str]) -> FigureOptions:
    """The options of `figure_keys`; `UserError` where one is of a format of which none is in `formats`."""
    from motionloom.pipeline.inference.files.display_figure import FigureOptions

    discover()
    more: dict[str, object] = {}
    own: dict[str, object] = {}
    for option, value in values.items():
        takers = [name for name, writer in WRITERS.items() if option in writer.options]
        forms = _MADE_BY.get(option, takers)
        if value is not None and forms and not {*forms} & {*formats}:
            raise UserError(f"{option} is what --format {forms[0]} is made by: name that format too")
        (more if takers else own)[option] = value
    return FigureOptions.parse({**own, "more": more}, "--set")


def known_format(name: str) -> str:
    """The name; ValueError where there is no such format."""
    if name not in WRITERS:
        raise ValueError(f"no format '{name}'; known: {', '.join(WRITERS)}")
    return name


Format = Annotated[str, AfterValidator(known_format)]
"""A name of `WRITERS`, in a config."""


def writer_for(path: Path) -> Writer:
    """The format of a file's ending; `UserError` where there is none."""
    discover()
    fitting = [writer for writer in WRITERS.values() if path.name.lower().endswith(writer.suffix)]
    if not fitting:
        known = ", ".join(writer.suffix for writer in WRITERS.values())
        ending = f"'{path.suffix}'" if path.suffix else "no ending"
        raise UserError(f"{path}: a motion cannot be saved with {ending}; name a file that ends in {known}")
    return max(fitting, key=lambda writer: len(writer.suffix))
