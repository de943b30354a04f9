"""MP4 of one motion: the body is drawn, imageio-ffmpeg's ffmpeg encodes (H.264 and AAC)."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from motionloom.datasets.base.files import atomic_path
from motionloom.datasets.motion.rigid import RigidMotion
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.pipeline.render.actor import Actor, actor_for, draw_actor
from motionloom.pipeline.render.camera import VIEWS, Camera, fit_distance, floor_of, smooth_path
from motionloom.pipeline.render.figure import figure_for
from motionloom.pipeline.render.lettering import font, wrap
from motionloom.pipeline.render.raster import SKY, draw_ground, halve
from motionloom.pipeline.render.sound import RATE, Soundtrack, film_sound

Progress = Callable[[int, int], None]


def write_mp4(
    path: Path,
    joints: NDArray[Any],
    skeleton: Skeleton,
    fps: float,
    caption: str = "",
    *,
    size: tuple[int, int] = (512, 512),
    view: str = "3/4",
    follow: bool = True,
    sound: Soundtrack | None = None,
    figure: RigidMotion | None = None,
    face_controls: NDArray[Any] | None = None,
    progress: Progress | None = None,
) -> None:
    """Film joints [T, N, 3] (metres, Y up); `progress(done, total)` is called after every frame.

    `sound` starts with the first frame; it is cut, or filled up with silence, to the T / fps seconds of the
    film. `figure` is the rigid figure whose joints these are, where there is one; `face_controls` [T, 5] are
    the viewer's. The file appears under its name only when it is whole. `size` is rounded up to even numbers
    for H.264.
    """
    import imageio_ffmpeg  # the binary is looked up on import: only for those who film

    width, height = (side + side % 2 for side in size)
    frames = render_frames(
        joints,
        skeleton,
        fps,
        caption,
        size=(width, height),
        view=view,
        follow=follow,
        figure=figure,
        face_controls=face_controls,
    )
    # Named, because the temporary file's ending does not say it.
    form = ["-f", "mp4", "-movflags", "+faststart"]
    with atomic_path(path) as temporary:
        wav = temporary.with_suffix(".wav")
        writer = imageio_ffmpeg.write_frames(
            str(temporary),
            (width, height),
            fps=fps,
            codec="libx264",
            pix_fmt_out="yuv420p",
            macro_block_size=2,
            output_params=["-preset", "veryfast", "-crf", "20", *form]
            + ([] if sound is None else ["-ar", str(RATE), "-b:a", "128k"]),
            audio_path=None if sound is None else str(wav),
            audio_codec=None if sound is None else "aac",
            ffmpeg_log_level="error",
        )
        try:
            if sound is not None:
                wav.write_bytes(film_sound(sound, len(joints) / fps))
            # Products of small matrices: several threads would wait for each other longer than they work.
            with closing(writer), threadpool_limits(1, user_api="blas"):
                writer.send(None)  # starts ffmpeg, which opens the WAV
                for done, frame in enumerate(frames, start=1):
                    writer.send(frame.tobytes())
                    if progress is not None:
                        progress(done, len(joints))
        except OSError as error:
            if error.errno is not None:
                raise
            raise UserError(_unfinished(path, str(error))) from None  # ffmpeg has ended before us
        finally:
            wav.unlink(missing_ok=True)
        if not _is_whole(temporary):
            raise UserError(_unfinished(path, "its file is cut short"))


def _unfinished(path: Path, why: str) -> str:
    reason = (why.strip().splitlines() or ["no reason given"])[0]
    return f"{path}: ffmpeg could not write the film ({reason}); is the disk full? No film is left there"


def _is_whole(path: Path) -> bool:
    """Whether the boxes of an MP4 file, its index among them, fill it to the end; ffmpeg's own exit code is
    not passed on to us.
    """
    names, at, size = set(), 0, path.stat().st_size
    with path.open("rb") as file:
        while at + 8 <= size:
            file.seek(at)
            length, name = struct.unpack(">I4s", file.read(8))
            if length == 1:
                length = struct.unpack(">Q", file.read(8))[0]
            if length < 8:
                return False
            names.add(name)
            at += length
    return at == size and {b"moov", b"mdat"} <= names


def render_frames(
    joints: NDArray[Any],
    skeleton: Skeleton,
    fps: float,
    caption: str = "",
    *,
    size: tuple[int, int] = (512, 512),
    view: str = "3/4",
    follow: bool = True,
    figure: RigidMotion | None = None,
    face_controls: NDArray[Any] | None = None,
) -> Iterator[Image.Image]:
    """Yield one RGB picture of `size` per frame of joints [T, N, 3]; see `write_mp4`."""
    exact = np.asarray(joints, np.float64)
    if exact.ndim != 3 or exact.shape[1:] != (len(skeleton), 3) or not len(exact):
        raise UserError(
            f"joints must be [T, {len(skeleton)}, 3] for {skeleton.name}, got {list(exact.shape)}"
        )
    if not np.isfinite(exact).all():
        raise UserError("joints hold NaN or infinity; nothing sensible can be filmed")
    if view not in VIEWS:
        raise UserError(f"no view '{view}'; known: {', '.join(VIEWS)}")
    actor = actor_for(exact, skeleton.parents, figure, face_controls)
    return _frames(exact, actor, skeleton, fps, caption, size, view, follow)


def _frames(
    joints: NDArray[np.float64],
    actor: Actor,
    skeleton: Skeleton,
    fps: float,
    caption: str,
    size: tuple[int, int],
    view: str,
    follow: bool,
) -> Iterator[Image.Image]:
    scale, floor = figure_for(skeleton.parents, joints).scale(joints), floor_of(joints)
    target = smooth_path(joints[:, 0], fps)
    spread = np.linalg.norm(joints[..., [0, 2]] - target[:, None][..., [0, 2]], axis=-1).max(axis=1)
    travel = 0.0
    if not follow:
        low, high = target.min(axis=0), target.max(axis=0)
        travel = float(np.linalg.norm((high - low)[[0, 2]])) / 2
        target[:] = (low + high) / 2
    height = float(np.clip(np.percentile(joints[..., 1].max(axis=1), 98) - floor + 0.2 * scale, 0.3, 5))
    radius = float(np.clip(np.percentile(spread, 90) + 0.06, 0.2, 4))
    target[:, 1] = floor + 0.455 * height
    yaw, pitch = VIEWS[view]
    big = (2 * size[0], 2 * size[1])
    camera = Camera(yaw, pitch, fit_distance(height, radius, *big, travel), *big)
    face = font(max(11, size[1] // 30))
    lines = wrap(caption, size[0] - 24, face, 2) if caption else []
    sky = Image.new("RGB", big, SKY)
    for frame in range(len(joints)):
        ground = sky.copy()
        draw_ground(ImageDraw.Draw(ground), camera, target[frame], floor, joints[:, 0])
        image = np.array(ground)
        draw_actor(image, camera, target[frame], floor, actor, frame)
        small = halve(Image.fromarray(image))
        if lines:
            below = ImageDraw.Draw(small)
            step = size[1] // 30 * 1.35
            for row, line in enumerate(lines):
                y = size[1] - 10 - step * (len(lines) - row)
                below.text((12, y), line, fill=(36, 42, 56), font=face)
        yield small
