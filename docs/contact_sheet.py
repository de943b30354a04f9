"""Contact sheets: motions as rows, a few poses each along time, captions as text; PNG for documents."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from motionloom.datasets.base.files import write_bytes
from motionloom.datasets.motion.body.rigid import RigidMotion
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.pipeline.render.camera import VIEWS, Camera, fit_distance, floor_of
from motionloom.pipeline.render.scene import SOLE, Actor, Ground, draw_figure

T = TypeVar("T")
FACE = ImageFont.load_default(14)

SKELETONS = {52: "smplx52", 22: "smpl22"}
PAPER, INK, SOFT, LINE = (255, 255, 255), (29, 35, 48), (91, 100, 117), (226, 230, 237)
LABEL = (47, 111, 219)


def contact_sheet(
    path: Path,
    joints: Sequence[NDArray[np.floating]],
    labels: Sequence[str],
    captions: Sequence[str],
    frames: int = 6,
    *,
    at: Sequence[Sequence[int]] | None = None,
    figures: Sequence[RigidMotion | None] | None = None,
    face_controls: Sequence[NDArray[np.floating] | None] | None = None,
    fps: float = 20.0,
    cell: tuple[int, int] = (180, 236),
    view: str = "3/4",
) -> None:
    """Write a PNG: a row per motion [T, N, 3] (metres) with label, caption and `frames` poses over time.

    Motions have the 52 or 22 joints of SMPL-X. `at` names the frames of every row, `frames` of them; without
    it they are spread evenly. `figures` are the rigid figures whose joints these are and
    `face_controls` [T, 5] those of the viewer, where a row has them. Poses stand in mid-cell, with
    their times.
    """
    if not len(joints) == len(labels) == len(captions) or not len(joints) or frames < 1:
        raise UserError(
            "contact_sheet needs as many labels and captions as motions, and at least one of each"
        )
    if at is not None and [len(row) for row in at] != [frames] * len(joints):
        raise UserError(f"contact_sheet needs {frames} frames for each of {len(joints)} rows in `at`")
    width, height = cell
    heading = 48 if _two_lines(labels, captions, width * frames) else 30
    rows = [np.asarray(clip, np.float64) for clip in joints]
    # One scale for the whole sheet, so that rows can be compared.
    tall = max(float(np.percentile(r[..., 1].max(axis=1), 98)) - floor_of(r) + 0.2 for r in rows)
    radius = max(
        float(np.percentile(np.linalg.norm(r[..., [0, 2]] - r[:, :1, [0, 2]], axis=-1).max(axis=1), 90))
        for r in rows
    )
    yaw, pitch = VIEWS[view]
    distance = fit_distance(float(np.clip(tall, 0.3, 5)), float(np.clip(radius, 0.2, 2)), width, height)
    camera = Camera(yaw, pitch, distance, width, height)
    sheet = Image.new("RGB", (width * frames, (height + heading) * len(rows)), PAPER)
    draw = ImageDraw.Draw(sheet)
    stamps = []
    bodies, faces = _each(figures, rows), _each(face_controls, rows)
    for row, (clip, figure, face) in enumerate(zip(rows, bodies, faces, strict=True)):
        top = row * (height + heading)
        actor, floor = _actor(clip, figure, face), floor_of(clip)
        draw.rectangle([0, top + heading, sheet.width, top + heading + height], fill=(247, 248, 251))
        draw.line([0, top, sheet.width, top], fill=LINE)
        ground = Ground(camera, floor + 0.47 * tall, floor - SOLE)
        shown = np.linspace(0, len(clip) - 1, frames).round().astype(int).tolist() if at is None else at[row]
        for column, k in enumerate(shown):
            target = np.array([clip[k, 0, 0], floor + 0.47 * tall, clip[k, 0, 2]])
            corner = (column * width, top + heading)
            picture = np.array(sheet.crop((*corner, corner[0] + width, corner[1] + height)))
            ground.cast_shadow(picture, target, actor, k)
            draw_figure(picture, camera, target, actor, k, "near")
            sheet.paste(Image.fromarray(picture), corner)
            stamps.append((corner[0] + 8, top + heading + height - 20, f"{k / fps:.1f} s"))
    _words(sheet, labels, captions, stamps, height + heading)
    data = io.BytesIO()
    sheet.save(data, "PNG", optimize=True)
    write_bytes(path, data.getvalue())


def _two_lines(labels: Sequence[str], captions: Sequence[str], width: int) -> bool:
    return any(
        FACE.getlength(label) + FACE.getlength(caption) + 34 > width
        for label, caption in zip(labels, captions, strict=True)
    )


def _words(
    sheet: Image.Image,
    labels: Sequence[str],
    captions: Sequence[str],
    stamps: Sequence[tuple[int, int, str]],
    pitch: int,
) -> None:
    """Labels in a colour of their own, captions beside them, times small."""
    draw = ImageDraw.Draw(sheet)
    tiny = ImageFont.load_default(11)
    for row, (label, caption) in enumerate(zip(labels, captions, strict=True)):
        x = 10.0
        if label:
            draw.text((x, row * pitch + 6), label, fill=LABEL, font=FACE)
            x += float(FACE.getlength(label)) + 14
        letters = int((sheet.width - x - 10) / FACE.getlength("n"))
        for number, line in enumerate(textwrap.wrap(caption, letters, max_lines=2, placeholder=" …")):
            draw.text((x, row * pitch + 6 + 18 * number), line, fill=INK, font=FACE)
    for x_at, y_at, text in stamps:
        draw.text((x_at, y_at), text, fill=SOFT, font=tiny)


def _each(given: Sequence[T | None] | None, rows: Sequence[object]) -> Sequence[T | None]:
    return [None] * len(rows) if given is None else given


def _actor(clip: NDArray[np.float64], figure: RigidMotion | None, face: NDArray[np.floating] | None) -> Actor:
    if clip.ndim != 3 or not np.isfinite(clip).all() or clip.shape[1] not in SKELETONS:
        raise UserError(f"contact_sheet draws finite joints [T, 52 or 22, 3], got {list(clip.shape)}")
    return Actor.of(clip, Skeleton.named(SKELETONS[clip.shape[1]]), figure, face)
