"""`motionloom generate` and `motionloom edit`: motions written to files, or streamed as JSON lines."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from rich.console import Console

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.sampling import SamplingConfig, StreamConfig
from motionloom.pipeline.inference.requests import caption_list, remarks_of, require_seed, require_words
from motionloom.pipeline.inference.writers import WRITERS, default_formats
from motionloom.pipeline.launch.console import make_console
from motionloom.pipeline.launch.hardware import choose_device, threads_for
from motionloom.pipeline.runs.resolve import nearest
from motionloom.pipeline.store.files import require_file_place, require_folder

if TYPE_CHECKING:
    from motionloom.pipeline.contract.editing import EditTask
    from motionloom.pipeline.inference.bundle import Bundle
    from motionloom.pipeline.inference.motion import GeneratedMotion
    from motionloom.pipeline.inference.stream import MotionStream

STDIN = "-"
"""The caption that means the lines of standard input."""


@contextmanager
def _film_progress(console: Console) -> Iterator[Callable[[int, int], None]]:
    """A bar of frames done, which appears with a film's first one; give what it yields to `write_motions`."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("film, frame"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("film", visible=False)
        yield lambda done, total: bar.update(task, completed=done, total=total, visible=done < total)


def _require_driver(
    captions: Sequence[str],
    face: Sequence[str] | None,
    audio: Sequence[Path],
    script: Path | None,
    seconds: float | None,
) -> None:
    """Refuse a request without anything that drives motion, and one with a script and more."""
    if not captions and not audio and script is None:
        raise UserError('give at least one caption, like: motionloom generate RUN "a person waves"')
    if script is not None and (captions or audio or seconds is not None or face):
        raise UserError(
            f"{script}: a script says everything: leave captions, face, --audio and --seconds out"
        )


def _open(folder: Path, device: str, console: Console) -> Bundle:
    from motionloom.pipeline.inference.bundle import Bundle

    bundle = Bundle.open(folder, choose_device(device))
    _print_model(folder, console)
    return bundle


def _print_model(folder: Path, console: Console) -> None:
    """Say which model is taken, where a name could mean a folder or one that comes with the package."""
    from motionloom.pipeline.inference.shipped_models import say_model

    if (taken := say_model(folder)) is not None:
        console.print(taken, markup=False, highlight=False, soft_wrap=True)


def _print_note(console: Console, note: object) -> None:
    console.print(f"note: {note}", style="yellow", markup=False, highlight=False, soft_wrap=True)


def formats_of(formats: str | None) -> list[str]:
    """The formats of `--format`, in its words; the default ones without."""
    wanted = default_formats()
    if formats is not None:
        wanted = [name.strip() for name in formats.split(",") if name.strip()]
    for name in wanted:
        if name not in WRITERS:
            raise UserError(f"--format {name}: no such format{nearest(name, list(WRITERS))}")
    if not wanted:
        raise UserError(f"--format {formats!r} names no format; known: {', '.join(WRITERS)}")
    return wanted


def generate_motions(
    folder: Path,
    captions: Sequence[str] = (),
    *,
    face: Sequence[str] | None = None,
    audio: Sequence[Path] = (),
    script: Path | None = None,
    samples: int = 1,
    out: Path,
    formats: str | None = None,
    seconds: float | None = None,
    seed: int = 0,
    sampling: SamplingConfig | None = None,
    seed_motion: Path | None = None,
    figure: Mapping[str, object] | None = None,
    device: str = "auto",
    console: Console,
) -> list[Path]:
    """Generate and write; returns the paths. `device`: auto, cpu, cuda or cuda:N.

    From captions, sound files, or both side by side (the first caption with the first file, and so on), or
    from one script. `samples` motions of each. `seed_motion` is a clip to go on from. `figure` are the keys
    of `FigureOptions`.
    """
    from motionloom.datasets.audio.sound import Excerpt
    from motionloom.pipeline.inference.outputs import page_note, page_title
    from motionloom.pipeline.inference.script import Script, read_music
    from motionloom.pipeline.inference.shown import FigureOptions

    _require_driver(captions, face, audio, script, seconds)
    if samples < 1:
        raise UserError(f"--samples {samples}: take 1 or more")
    if script is not None and seed_motion is not None:
        raise UserError("a script's motion goes on from no other: leave seed_motion out")
    wanted = formats_of(formats)
    # All that needs no model is checked before one is opened.
    require_words(caption_list(captions))
    require_seed(seed)
    require_folder(out)
    sampling = sampling or SamplingConfig()
    posing = FigureOptions.parse(figure or {}, "figure")
    if posing.body_model is not None and "smplx" not in wanted:
        raise UserError("body_model is what --format smplx is made for: name that format too")
    if posing.arkit_bases is not None and "arkit" not in wanted:
        raise UserError("arkit_bases is what --format arkit is made by: name that format too")
    segments = None if script is None else Script.read(script).open(script.parent, str(script))
    sounds = [read_music(path) for path in audio]
    with threads_for(samples * max(len(captions), len(audio), 1)):
        aside = make_console(aside=True)  # standard output is the list of files
        bundle = _open(folder, device, aside)
        if segments is not None:
            motions = bundle.perform(segments, samples=samples, seed=seed, sampling=sampling)
        else:
            begun = None
            if seed_motion is not None:
                from motionloom.pipeline.inference.edits.clip_file import read_seed_motion

                begun = [read_seed_motion(seed_motion, bundle.layout)]
            motions = bundle.generate(
                [text for text in captions for _ in range(samples)] or None,
                face=face and (list(face) if len(face) == 1 else [t for t in face for _ in range(samples)]),
                sounds=[sound for sound in sounds for _ in range(samples)] or None,
                seconds=seconds,
                seed=seed,
                sampling=sampling,
                seed_motions=begun,
                strict=True,
            )
            if seed_motion is None and (seed_frames := bundle.generator.capabilities.seed_frames):
                start = seed_frames / bundle.layout.fps
                _print_note(
                    aside,
                    f"the first {start:.2g} s are of a training dance; --set seed_motion=FILE takes yours",
                )
        said = captions if segments is None else [segment.prompt.text for segment in segments]
        notes = [
            *bundle.unknown_captions(said, face or (), sampling.face_model),
            *bundle.find_mismatches(motions),
        ]
        for note in notes:
            _print_note(aside, note)
        driven = motions if segments is None else segments
        for remark in remarks_of(one.prompt for one in driven):
            _print_note(aside, remark)
        title = page_title([motion.caption for motion in motions], [path.name for path in audio], script)
        note = page_note(len(motions), folder.resolve().name, seed, notes)
        named = [Excerpt.named(path).path.stem for path in audio for _ in range(samples)]
        return _write(
            out,
            motions,
            wanted,
            title=title,
            note=note,
            seed=seed,
            names=None if captions or not named else named,
            figure=posing,
            say=lambda line: aside.print(line, soft_wrap=True, markup=False),
            console=console,
            aside=aside,
        )


def edit_clip_file(
    folder: Path,
    clip: Path,
    task: EditTask,
    *,
    samples: int,
    out: Path,
    formats: str | None,
    seed: int,
    sampling: SamplingConfig,
    figure: Mapping[str, object],
    device: str,
    console: Console,
) -> list[Path]:
    """Edit as `MotionModel.edit` and write, the clip first; returns the paths. `formats` as `--format`."""
    from motionloom.pipeline.inference.model import MotionModel
    from motionloom.pipeline.inference.outputs import page_note
    from motionloom.pipeline.inference.shown import FigureOptions

    wanted = formats_of(formats)
    require_folder(out)
    posing = FigureOptions.parse(figure, "figure")
    aside = make_console(aside=True)  # standard output is the list of files
    model = MotionModel(folder, device)
    _print_model(folder, aside)
    motions = model.edit(clip, task, samples=samples, seed=seed, sampling=sampling)
    for remark in motions[0].remarks:
        _print_note(aside, remark)
    for number, motion in enumerate(motions, start=1):
        for line in motion.report.lines():
            prefix = f"{number}: " if samples > 1 else ""
            aside.print(f"{prefix}{line}", markup=False, highlight=False, soft_wrap=True)
    return _write(
        out,
        [motions[0].original, *motions],
        wanted,
        title=f"{clip.name}, edited",
        note=page_note(len(motions), folder.resolve().name, seed, motions[0].remarks),
        seed=seed,
        names=[clip.stem, *[f"{clip.stem} edited" for _ in motions]],
        labels=["the clip", *["edited" for _ in motions]],
        figure=posing,
        console=console,
        aside=aside,
    )


def _write(
    out: Path,
    motions: Sequence[GeneratedMotion],
    formats: Sequence[str],
    *,
    console: Console,
    aside: Console,
    **options: Any,
) -> list[Path]:
    """Write motions as `write_motions` does, list the files on `console`, and say where the page is."""
    from motionloom.pipeline.inference.outputs import write_motions

    with _film_progress(aside) as progress:
        paths = write_motions(out, motions, formats, progress=progress, **options)
    for path in paths:
        console.print(str(path), markup=False, soft_wrap=True)
    if "html" in formats:
        place = (out / "index.html").resolve()
        aside.print(f"watch it in a browser: {place}", markup=False, highlight=False, soft_wrap=True)
    return paths


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
    sampling: SamplingConfig | None = None,
    device: str = "auto",
    console: Console,
    given: TextIO | None = None,
) -> None:
    """Write JSON lines (`inference/writers.py`) as frames come; ends with the last segment or Ctrl-C.

    Several captions follow each other, each `seconds` long. The caption "-" is the lines of `given`, by
    default standard input: with `seconds` each lasts so long, without each takes over from the one before,
    and frames come no faster than they are watched.
    `out` is a file, None is standard output. What is said to people goes to `console`.
    """
    from motionloom.pipeline.inference.script import Script, read_music
    from motionloom.pipeline.inference.stream import MotionStream, stream_of
    from motionloom.pipeline.inference.writers import frame_lines, heading

    _require_driver(captions, face, audio, script, seconds)
    if len(captions) > 1 and (seconds is None or STDIN in captions or audio or face):
        raise UserError(
            "a stream of several captions makes one motion: give --seconds, the length of each, and neither "
            "--audio nor face; in a script each has its own"
        )
    if len(audio) > 1 or (face and len(face) > 1):
        raise UserError("a stream makes one motion: give one --audio and one face")
    require_seed(seed)
    out = None if out is not None and str(out) == STDIN else out
    if out is not None:
        require_file_place(out)
    sampling = sampling or SamplingConfig()
    sound = read_music(audio[0]) if audio else None
    opened = None if script is None else Script.read(script).open(script.parent, str(script))
    bundle, config, live = _open(folder, device, console), StreamConfig(), False

    def notice(unknown: object) -> None:
        _print_note(console, unknown)

    if opened is not None:
        stream = MotionStream(
            bundle, iter(opened), seed=seed, sampling=sampling, config=config, notice=notice
        )  # fmt: skip
    else:
        asked: str | list[str] | Iterator[str] | None = list(captions) if len(captions) > 1 else None
        lines: Iterator[str] = iter(())
        if list(captions) == [STDIN]:
            lines = (line.strip() for line in given or sys.stdin if line.strip())
            live = seconds is None
            asked = next(lines, None) if live else lines
            if asked is None:
                raise UserError("standard input has no caption; write one a line")
        elif len(captions) == 1:
            asked = captions[0]
        stream = stream_of(
            bundle, asked, face=face[0] if face else "", sound=sound, seconds=seconds, seed=seed,
            sampling=sampling, notice=notice,
        )  # fmt: skip
        if live:
            listener = threading.Thread(target=_listen, args=(stream, lines, console), daemon=True)
            listener.start()
    with _stream_file(out) as file:
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


@contextmanager
def _stream_file(out: Path | None) -> Iterator[TextIO]:
    """The file of a stream, or standard output; what cannot be written leaves no half of a file."""
    try:
        if out is None:
            yield sys.stdout
            sys.stdout.flush()
            return
        with out.open("w", encoding="utf-8") as file:
            yield file
    except OSError as error:
        if out is not None and out.is_file():
            out.unlink()
        place = "standard output" if out is None else f"{out}"
        raise UserError(f"{place}: the stream cannot be written ({error.strerror or error})") from None


def _listen(stream: MotionStream, lines: Iterator[str], console: Console) -> None:
    """Each line takes over from the one before as it comes."""
    for line in lines:
        try:
            stream.say(line)
        except UserError as error:
            console.print(f"{error}", style="red", markup=False)
