"""MP4 of one motion: the body is drawn here, imageio-ffmpeg's ffmpeg encodes (H.264 and AAC)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from subprocess import PIPE, Popen

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.files import atomic_path
from motionloom.datasets.motion.body.rigid import RigidMotion
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.schema import UserError
from motionloom.pipeline.render.camera import VIEWS, Camera, fit_distance, floor_of, smooth_path
from motionloom.pipeline.render.scene import SOLE, Actor, Ground, detail_for, draw_figure
from motionloom.pipeline.render.sound import RATE, film_sound

Progress = Callable[[int, int], None]


def write_mp4(
    path: Path,
    joints: NDArray[np.floating],
    skeleton: Skeleton,
    fps: float,
    caption: str = "",
    *,
    size: tuple[int, int] = (512, 512),
    sound: Sound | None = None,
    figure: RigidMotion | None = None,
    face_controls: NDArray[np.floating] | None = None,
    progress: Progress | None = None,
) -> None:
    """Film joints [T, N, 3] (metres, Y up); `progress(done, total)` is called after every frame.

    `sound` starts with the first frame; it is cut, or filled up with silence, to the T / fps seconds of the
    film. `figure` is the rigid figure whose joints these are, where there is one; `face_controls` [T, 5] are
    the viewer's. The file appears under its name only when it is whole. `size` is rounded up to even numbers
    for H.264.
    """
    try:
        from imageio_ffmpeg import get_ffmpeg_exe  # the binary is looked up: only for those who film
    except ModuleNotFoundError:
        raise UserError(f"{path}: films need imageio-ffmpeg; pip install 'motionloom[film]'") from None
    width, height = (side + side % 2 for side in size)
    exact = np.asarray(joints, np.float64)
    if not np.isfinite(exact).all():
        raise UserError("joints hold NaN or infinity; nothing sensible can be filmed")
    actor = Actor.of(exact, skeleton, figure, face_controls)
    frames = _frames(actor, fps, _subtitle(caption, (width, height)), (width, height))
    with atomic_path(path) as temporary:
        wav = temporary.with_suffix(".wav")
        sounds, codec = ["-an"], list[str]()
        if sound is not None:
            sounds = ["-i", str(wav)]
            codec = ["-ar", str(RATE), "-b:a", "128k", "-acodec", "aac", "-map", "0:v:0", "-map", "1:a:0"]
        pictures = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
        rate = str(Fraction(fps).limit_denominator())  # as a fraction, so that 24000/1001 is not rounded
        video = ["-vcodec", "libx264", "-pix_fmt", "yuv420p", "-preset", "veryfast", "-crf", "20"]
        # Named, because the temporary file's ending does not say it.
        form = ["-f", "mp4", "-movflags", "+faststart", str(temporary)]
        command = [get_ffmpeg_exe(), "-y", "-v", "error", *pictures, "-r", rate, "-i", "-", *sounds]
        try:
            if sound is not None:
                wav.write_bytes(film_sound(sound, len(joints) / fps))
            with Popen([*command, *video, *codec, *form], stdin=PIPE, stderr=PIPE) as ffmpeg:
                assert ffmpeg.stdin is not None
                with suppress(BrokenPipeError):  # ffmpeg has ended before us, and says why
                    for done, frame in enumerate(frames, start=1):
                        ffmpeg.stdin.write(frame.tobytes())
                        if progress is not None:
                            progress(done, len(joints))
                _, words = ffmpeg.communicate()
        finally:
            wav.unlink(missing_ok=True)
        if ffmpeg.returncode:
            reason = (words.decode(errors="replace").strip().splitlines() or ["no reason given"])[0]
            raise UserError(
                f"{path}: ffmpeg could not write the film ({reason}); is the disk full? No film is left there"
            )


def _frames(
    actor: Actor, fps: float, subtitle: Image.Image, size: tuple[int, int]
) -> Iterator[NDArray[np.uint8]]:
    """One RGB picture [height, width, 3] of each frame, by a camera that follows the figure."""
    joints = actor.posing.joints
    floor = floor_of(joints)
    # The camera follows a smoothed path: following every step would shake the ground.
    target = smooth_path(joints[:, 0], fps)
    spread = np.linalg.norm(joints[..., [0, 2]] - target[:, None][..., [0, 2]], axis=-1).max(axis=1)
    # Percentiles, so that one stray frame does not make the figure small in all others.
    height = float(np.clip(np.percentile(joints[..., 1].max(axis=1), 98) - floor + 0.2, 0.3, 5))
    radius = float(np.clip(np.percentile(spread, 90) + 0.06, 0.2, 4))
    target[:, 1] = floor + 0.455 * height
    camera = Camera(*VIEWS["3/4"], fit_distance(height, radius, *size), *size)
    # The camera never turns, so what its pixels see of the ground is computed once.
    ground = Ground(camera, floor + 0.455 * height, floor - SOLE)
    detail = detail_for(camera)
    for frame, middle in enumerate(target):
        image = ground.draw(middle)
        ground.draw_trail(image, middle, joints[:, 0])
        ground.cast_shadow(image, middle, actor, frame)
        draw_figure(image, camera, middle, actor, frame, detail)
        if subtitle.height:
            picture = Image.fromarray(image)
            picture.paste((36, 42, 56), (12, size[1] - subtitle.height - 10), subtitle)
            image = np.asarray(picture)
        yield image


def _subtitle(caption: str, size: tuple[int, int]) -> Image.Image:
    """The caption as a mask, in at most two lines, cut by an ellipsis; of no height without one."""
    face = ImageFont.load_default(max(11, size[1] // 30))
    step, width = round(size[1] / 30 * 1.35), size[0] - 24
    lines = [""] if caption else []
    for word in caption.split():
        longer = f"{lines[-1]} {word}".strip()
        if face.getlength(longer) <= width or not lines[-1]:
            lines[-1] = longer
        else:
            lines.append(word)
    if len(lines) > 2:
        lines = [lines[0], f"{lines[1]} …"]
    for row, line in enumerate(lines):
        while face.getlength(lines[row]) > width and line:
            line = line[:-1]
            lines[row] = line.rstrip(" …") + "…"
    out = Image.new("L", (size[0] - 24, step * len(lines)))
    for row, line in enumerate(lines):
        ImageDraw.Draw(out).text((0, row * step), line, fill=255, font=face)
    return out
