"""`generate --stream`: motion on standard output, or into a file, while it is made."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from rich.console import Console

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.streaming import StreamConfig
from motionloom.pipeline.inference.requests import require_seed
from motionloom.pipeline.launch.hardware import choose_device
from motionloom.pipeline.store.files import require_file_place

if TYPE_CHECKING:
    from motionloom.pipeline.inference.bundle import Bundle
    from motionloom.pipeline.inference.streaming import MotionStream
    from motionloom.pipeline.store.known_captions import Unknown

STDIN = "-"
"""The caption that stands for the lines of standard input."""


def stream_motion(
    folder: Path,
    captions: Sequence[str] = (),
    *,
    face: Sequence[str] | None = None,
    audio: Sequence[Path] = (),
    script: Path | None = None,
    out: Path | None = None,
    seconds: float | None = None,
    seed: int = 0,
    sampling: dict[str, Any] | None = None,
    device: str = "auto",
    console: Console,
    given: TextIO | None = None,
) -> None:
    """Write JSON lines (`inference/stream_lines.py`) as frames come; ends with the last segment or Ctrl-C.

    Several captions follow each other, each `seconds` long. The caption "-" is the lines of `given`, by
    default standard input: with `seconds` each lasts so long, without each takes over from the one before,
    and frames come no faster than they are watched.
    `out` is a file, None is standard output. What is said to people goes to `console`.
    """
    from motionloom.pipeline.inference.bundle import Bundle
    from motionloom.pipeline.inference.script import Script, read_music
    from motionloom.pipeline.inference.shipped_models import say_model
    from motionloom.pipeline.inference.stream_lines import frame_lines, heading
    from motionloom.pipeline.inference.stream_request import stream_of
    from motionloom.pipeline.inference.streaming import MotionStream

    if not captions and not audio and script is None:
        raise UserError('give a caption, like: motionloom generate RUN --stream "a person waves"')
    if script is not None and (captions or audio or seconds is not None or face):
        raise UserError("--script says everything: leave captions, --face, --audio and --seconds out")
    if len(captions) > 1 and (seconds is None or STDIN in captions or audio or face):
        raise UserError(
            "a stream of several captions makes one motion: give --seconds, the length of each, and neither "
            "--audio nor --face; with --script each has its own"
        )
    if len(audio) > 1 or (face and len(face) > 1):
        raise UserError("a stream makes one motion: give one --audio and one --face")
    require_seed(seed)
    if out is not None:
        require_file_place(out)
    drawing = SamplingConfig.parse(sampling or {}, "sampling")
    sound = read_music(audio[0]) if audio else None
    opened = None if script is None else Script.read(script).open(script.parent, str(script))
    bundle = Bundle.open(folder, choose_device(device))
    if (taken := say_model(folder)) is not None:
        console.print(taken, markup=False, highlight=False, soft_wrap=True)

    def notice(unknown: Unknown) -> None:
        console.print(f"note: {unknown}", style="yellow", markup=False, highlight=False, soft_wrap=True)

    config, words = StreamConfig(), face[0] if face else ""
    live = list(captions) == [STDIN] and seconds is None
    if opened is not None:
        stream = MotionStream(
            bundle, iter(opened), seed=seed, sampling=drawing, config=config, notice=notice
        )  # fmt: skip
    elif list(captions) == [STDIN]:
        stream = _of_lines(bundle, given or sys.stdin, seconds, seed, drawing, console, notice)
    else:
        asked = (captions[0] if captions else None) if len(captions) < 2 else list(captions)
        stream = stream_of(
            bundle, asked, face=words, sound=sound, seconds=seconds, seed=seed, sampling=drawing,
            notice=notice,
        )  # fmt: skip
    with ExitStack() as stack:
        file: TextIO = sys.stdout if out is None else stack.enter_context(out.open("w", encoding="utf-8"))
        file.write(heading(bundle.layout, seed, folder.resolve().name))
        file.flush()
        started, first, frames = time.perf_counter(), math.nan, 0
        try:
            for chunk in stream:
                for line in frame_lines(chunk):
                    file.write(line)
                file.flush()
                first = time.perf_counter() - started if not frames else first
                frames += len(chunk.joints)
                if live:
                    early = (
                        frames / chunk.fps - config.ahead_seconds - (time.perf_counter() - started - first)
                    )
                    time.sleep(max(0.0, early))
        except KeyboardInterrupt:  # how a stream without an end is ended
            console.print("ended")
    took, length = time.perf_counter() - started, frames / bundle.layout.fps
    console.print(
        f"{frames} frames, {length:.1f} s of motion in {took:.1f} s; the first after {first:.2f} s",
        highlight=False,
    )


def _of_lines(
    bundle: Bundle,
    given: TextIO,
    seconds: float | None,
    seed: int,
    sampling: SamplingConfig,
    console: Console,
    notice: Callable[[Unknown], object],
) -> MotionStream:
    """A stream whose captions are lines, read as they come."""
    from motionloom.pipeline.inference.stream_request import stream_of

    lines: Iterator[str] = (line.strip() for line in given if line.strip())
    if seconds is not None:
        return stream_of(bundle, lines, seconds=seconds, seed=seed, sampling=sampling, notice=notice)
    first = next(lines, None)
    if first is None:
        raise UserError("standard input has no caption; write one a line")
    stream = stream_of(bundle, first, seed=seed, sampling=sampling, notice=notice)

    def listen() -> None:
        for line in lines:
            try:
                stream.say(line)
            except UserError as error:
                console.print(f"{error}", style="red", markup=False)

    threading.Thread(target=listen, daemon=True, name="captions").start()
    return stream
