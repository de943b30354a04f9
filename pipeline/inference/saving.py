"""One motion to one file, and to a notebook: the functions that `motion.WRITERS` names."""

from __future__ import annotations

from html import escape
from pathlib import Path

from motionloom.datasets.base.files import write_text
from motionloom.datasets.schema import UserError
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.outputs import (
    film,
    score_of,
    viewer_motion,
    write_bvh_of,
    write_glb_of,
    write_npz,
)
from motionloom.pipeline.inference.page_words import page_title
from motionloom.pipeline.inference.shown import shown
from motionloom.pipeline.render.viewer import ViewerMotion, viewer_page


def save_npz(path: Path, motion: GeneratedMotion) -> None:
    """Joints, features and facts."""
    write_npz(_place(path), motion, motion.seed)


def save_bvh(path: Path, motion: GeneratedMotion) -> None:
    """Bone rotations."""
    write_bvh_of(_place(path), motion)


def save_glb(path: Path, motion: GeneratedMotion) -> None:
    """The skinned figure, its motion and its face."""
    write_glb_of(_place(path), motion)


def save_mp4(path: Path, motion: GeneratedMotion) -> None:
    """A film, with its music."""
    film(_place(path), shown(motion), motion.prompt.sound)


def save_html(path: Path, motion: GeneratedMotion) -> None:
    """The viewer page."""
    write_text(_place(path), page_of(motion))


def page_of(motion: GeneratedMotion) -> str:
    """The viewer page as text."""
    return viewer_page([cell_of(motion)], page_title([motion.caption]))


def cell_of(motion: GeneratedMotion) -> ViewerMotion:
    """What the viewer shows of it."""
    return viewer_motion(motion, "generated", score=score_of(motion))


def frame_of(motion: GeneratedMotion, height: int = 480) -> str:
    """The page within an `iframe` whose script runs apart from all around it."""
    title, page = escape(motion.caption), escape(page_of(motion))
    return (
        f'<iframe sandbox="allow-scripts" title="{title}" loading="lazy" srcdoc="{page}" '
        f'style="width: 100%; height: {height}px; border: 0"></iframe>'
    )


def _place(path: Path) -> Path:
    """The path, where its folder exists."""
    if not path.parent.is_dir():
        raise UserError(f"{path}: there is no folder {path.parent}; make it first")
    return path
