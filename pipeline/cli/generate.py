"""`motionloom generate`: motions to files, or one motion as JSON lines while it is made."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import typer
from rich.console import Console

from motionloom.datasets.schema import UserError, nearest
from motionloom.pipeline.cli.options import At, Device, ModelFolder, Settings, settings_of
from motionloom.pipeline.inference.writers import WRITERS, default_formats, formats_help
from motionloom.pipeline.launch.console import make_console, say
from motionloom.pipeline.store.files import require_file_place, require_folder

if TYPE_CHECKING:
    from motionloom.pipeline.contract.sampling import SamplingConfig
    from motionloom.pipeline.inference.motion import GeneratedMotion

STREAM = "jsonl"
"""The format that is written while its one motion is made."""
_SCRIPTS = (".yaml", ".yml")


def generate(
    run_folder: ModelFolder,
    captions: Annotated[
        list[str] | None,
        typer.Argument(
            help="What the person does; one motion each. Or a script (.yaml) of text and music, one motion."
        ),
    ] = None,
    audio: Annotated[
        list[Path] | None,
        typer.Option("--audio", help="A wav, flac, mp3 or ogg file to move to; beside a caption, both."),
    ] = None,
    samples: Annotated[int, typer.Option(help="Motions of each caption, sound or script.")] = 1,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help=f"Folder for the files, default motions; of {STREAM} a file."),
    ] = None,
    formats: Annotated[
        str | None,
        typer.Option(
            "--format",
            "-f",
            help=f"{formats_help()} Or {STREAM} alone: one motion as JSON lines, written while it is made.",
        ),
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="Length; default: the model decides.")] = None,
    seed: Annotated[int, typer.Option(help="Same seed, captions and options: same motions.")] = 0,
    settings: Settings = None,
    at: At = None,
    device: Device = "auto",
) -> None:
    """Motions from captions, music or a script of both, as numbers and a page; other files on request.

    `--set` also takes face (what the face does, one text for all captions or a list), seed_motion (a clip to
    go on from, for FACT and Bailando), plant_feet (false: feet may slide), body_model (your SMPL-X model, for
    format smplx) and arkit_bases (your expression and ARKit bases, for arkit).

    Example: `motionloom generate synthetic "a person waves with the left hand"`

    Example: `motionloom generate runs/humantomato-tiny "a person waves" --set face="a happy face" -o out`

    Example: `motionloom generate runs/ude-tiny --audio song.ogg --samples 3 -o dances`

    Example: `motionloom generate runs/humantomato-tiny "a person bows" --format glb,html`

    Example: `motionloom generate runs/humantomato-tiny "a person walks" --seconds 60 -f jsonl -o walk.jsonl`
    """
    from motionloom.pipeline.contract.sampling import SamplingConfig
    from motionloom.pipeline.inference.requests import require_seed, require_words
    from motionloom.pipeline.inference.shown import FigureOptions
    from motionloom.pipeline.runs.snapshot import run_at

    fields, figure, more = settings_of(
        settings, SamplingConfig.model_fields, FigureOptions.model_fields, ("face", "seed_motion")
    )
    sampling = SamplingConfig.parse(fields, "--set")
    face, seed_motion = more.get("face"), more.get("seed_motion")
    faces = None if face is None else [str(one) for one in (face if isinstance(face, list) else [face])]
    texts, songs = list(captions or []), audio or []
    file = Path(texts.pop(0)) if texts and texts[0].lower().endswith(_SCRIPTS) else None
    # All that needs no model is checked before one is opened.
    if not texts and not songs and file is None:
        raise UserError('give at least one caption, like: motionloom generate RUN "a person waves"')
    if file is not None and (texts or songs or seconds is not None or faces or seed_motion):
        raise UserError(
            f"{file}: a script says everything: leave captions, --audio, --seconds, face and seed_motion out"
        )
    if samples < 1:
        raise UserError(f"--samples {samples}: take 1 or more")
    require_seed(seed)
    require_words(texts)
    streamed = formats is not None and STREAM in formats.split(",")
    if streamed and (samples != 1 or formats != STREAM or seed_motion is not None):
        raise UserError(
            f"--format {STREAM} writes one motion while it is made: leave other formats, --samples and "
            f"seed_motion out"
        )
    wanted = [] if streamed else formats_of(formats)
    with run_at(run_folder, at) as folder:
        asked = _Request(folder, device, texts, faces, songs, file, seconds, seed, sampling)
        if streamed:
            _stream(asked, out)
        else:
            _generate_files(asked, wanted, out or Path("motions"), samples, figure, seed_motion)


@dataclass(frozen=True)
class _Request:
    """Conditions of the motions, as the command line has them."""

    model: str
    device: str
    captions: list[str]
    faces: list[str] | None
    songs: list[Path]
    script: Path | None
    seconds: float | None
    seed: int
    sampling: SamplingConfig


def _generate_files(
    asked: _Request,
    formats: Sequence[str],
    out: Path,
    samples: int,
    figure: Mapping[str, object],
    seed_motion: object,
) -> None:
    from motionloom.datasets.audio.sound import Excerpt
    from motionloom.pipeline.inference.edits.clip_file import read_seed_motion
    from motionloom.pipeline.inference.model import MotionModel
    from motionloom.pipeline.inference.outputs import page_note, page_title
    from motionloom.pipeline.inference.script import Script, read_music
    from motionloom.pipeline.inference.shown import FigureOptions
    from motionloom.pipeline.launch.hardware import threads_for

    require_folder(out)
    posing = FigureOptions.parse(figure, "--set")
    if posing.body_model is not None and "smplx" not in formats:
        raise UserError("body_model is what --format smplx is made for: name that format too")
    if posing.arkit_bases is not None and "arkit" not in formats:
        raise UserError("arkit_bases is what --format arkit is made by: name that format too")
    segments = None if asked.script is None else Script.read(asked.script)
    sounds = [read_music(path) for path in asked.songs]
    faces, sampling = asked.faces, asked.sampling
    aside = make_console(aside=True)  # standard output is the list of files

    def each(values: Sequence[Any] | None) -> list[Any] | None:
        return [value for value in values or () for _ in range(samples)] or None

    with threads_for(samples * max(len(asked.captions), len(sounds), 1)):
        bundle = MotionModel(asked.model, asked.device).bundle
        if segments is not None:
            motions = bundle.perform(segments, samples=samples, seed=asked.seed, sampling=sampling)
        else:
            begun = None if seed_motion is None else [read_seed_motion(Path(str(seed_motion)), bundle.layout)]
            motions = bundle.generate(
                each(asked.captions),
                face=faces if faces is None or len(faces) == 1 else each(faces),
                sounds=each(sounds),
                seconds=asked.seconds,
                seed=asked.seed,
                sampling=sampling,
                seed_motions=begun,
                strict=True,
            )
            if begun is None and (seed_frames := bundle.generator.capabilities.seed_frames):
                start = seed_frames / bundle.layout.fps
                print_note(
                    aside,
                    f"the first {start:.2g} s are of a training dance; --set seed_motion=FILE takes yours",
                )
        prompts = [one.prompt for one in (segments or motions)]
        notes = bundle.notes(prompts, motions, sampling.face_model)
        for note in notes:
            print_note(aside, note)
        songs = [path.name for path in asked.songs]
        write_files(
            out,
            motions,
            formats,
            title=page_title([motion.caption for motion in motions], songs, asked.script),
            note=page_note(len(motions), Path(asked.model).resolve().name, asked.seed, notes, bundle.terms),
            seed=asked.seed,
            names=None if asked.captions else each([Excerpt.named(path).path.stem for path in asked.songs]),
            figure=posing,
            say=partial(say, aside),
        )


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


def print_note(console: Console, note: object) -> None:
    """Print what a person should know of a motion, in yellow."""
    say(console, f"note: {note}", "yellow")


def write_files(
    out: Path, motions: Sequence[GeneratedMotion], formats: Sequence[str], **options: Any
) -> None:
    """Write motions as `write_motions` does, show how far a film is, and list the files."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from motionloom.pipeline.inference.outputs import write_motions

    console, aside = make_console(), make_console(aside=True)
    columns = TextColumn("film, frame"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=aside, transient=True, disable=not aside.is_terminal) as bar:
        task = bar.add_task("film", visible=False)

        def progress(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total, visible=done < total)

        paths = write_motions(out, motions, formats, progress=progress, **options)
    for path in paths:
        say(console, str(path))
    if "html" in formats:
        say(aside, f"watch it in a browser: {(out / 'index.html').resolve()}")


def _stream(asked: _Request, out: Path | None) -> None:
    """Write JSON lines (`inference/writers.py`) as frames come, to a file or to standard output.

    Ends with the last segment or Ctrl-C.
    """
    from motionloom.pipeline.inference.model import MotionModel
    from motionloom.pipeline.inference.script import Script, read_music
    from motionloom.pipeline.inference.stream import MotionStream, segments_of
    from motionloom.pipeline.inference.writers import frame_lines, heading

    texts, faces, songs = asked.captions, asked.faces or [], asked.songs
    if len(songs) > 1 or len(faces) > 1 or (len(texts) > 1 and (asked.seconds is None or songs or faces)):
        raise UserError(
            "a stream makes one motion, of one --audio and one face; of several captions give --seconds, "
            "the length of each, and neither --audio nor face; in a script each has its own"
        )
    if out is not None:
        require_file_place(out)
    aside, face = make_console(aside=True), faces[0] if faces else ""
    segments = None if asked.script is None else Script.read(asked.script)
    sound = read_music(songs[0]) if songs else None
    bundle = MotionModel(asked.model, asked.device).bundle
    if len(texts) > 1:
        said = [{"text": text, "seconds": asked.seconds} for text in texts]
        segments = Script.parse({"segments": said}, "captions").open()
    driver = segments or segments_of(
        bundle, texts[0] if texts else None, face=face, sound=sound, seconds=asked.seconds
    )
    stream = MotionStream(
        bundle, driver, seed=asked.seed, sampling=asked.sampling, notice=partial(print_note, aside)
    )
    with _stream_file(out) as file:
        file.write(heading(stream.layout, stream.seed, Path(asked.model).resolve().name))
        file.flush()
        started, first, frames = time.perf_counter(), math.nan, 0
        try:
            for chunk in stream:
                file.writelines(frame_lines(chunk))
                file.flush()
                first = time.perf_counter() - started if not frames else first
                frames += len(chunk.joints)
        except KeyboardInterrupt:  # how a stream without an end is ended
            say(aside, "ended")
    took, length = time.perf_counter() - started, frames / stream.layout.fps
    say(aside, f"{frames} frames, {length:.1f} s of motion in {took:.1f} s; the first after {first:.2f} s")


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
