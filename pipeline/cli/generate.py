"""`motionloom generate`: motions to files."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.cli.options import At, Device, ModelFolder, Settings, settings_of
from motionloom.pipeline.inference.writers import default_formats, formats_help
from motionloom.pipeline.launch.console import make_console, say
from motionloom.pipeline.store.files import require_folder

if TYPE_CHECKING:
    from motionloom.pipeline.inference.motion import GeneratedMotion

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
    samples: Annotated[int, typer.Option(min=1, help="Motions of each caption, sound or script.")] = 1,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")] = Path("motions"),
    formats: Annotated[str | None, typer.Option("--format", "-f", help=formats_help())] = None,
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
    """
    from motionloom.datasets.audio.sound import Excerpt
    from motionloom.pipeline.contract.sampling import SamplingConfig
    from motionloom.pipeline.inference.edits.clip_file import read_seed_motion
    from motionloom.pipeline.inference.model import MotionModel
    from motionloom.pipeline.inference.outputs import page_note, page_title
    from motionloom.pipeline.inference.requests import require_seed, require_words
    from motionloom.pipeline.inference.script import Script, read_music
    from motionloom.pipeline.inference.shown import FigureOptions
    from motionloom.pipeline.launch.hardware import threads_for
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
    require_seed(seed)
    require_words(texts)
    wanted, posing = formats_of(formats), FigureOptions.parse(figure, "--set")
    for name, form in (("body_model", "smplx"), ("arkit_bases", "arkit")):
        if getattr(posing, name) is not None and form not in wanted:
            raise UserError(f"{name} is what --format {form} is made by: name that format too")
    with run_at(run_folder, at) as folder:
        require_folder(out)
        segments = None if file is None else Script.read(file)
        sounds = [read_music(path) for path in songs]
        aside = make_console(aside=True)  # standard output is the list of files

        def each(values: Sequence[Any]) -> list[Any] | None:
            return [value for value in values for _ in range(samples)] or None

        with threads_for(samples * max(len(texts), len(sounds), 1)):
            bundle = MotionModel(folder, device).bundle
            if segments is not None:
                motions = bundle.perform(segments, samples=samples, seed=seed, sampling=sampling)
            else:
                begun = (
                    None if seed_motion is None else [read_seed_motion(Path(str(seed_motion)), bundle.layout)]
                )
                motions = bundle.generate(
                    each(texts),
                    face=faces if faces is None or len(faces) == 1 else each(faces),
                    sounds=each(sounds),
                    seconds=seconds,
                    seed=seed,
                    sampling=sampling,
                    seed_motions=begun,
                    strict=True,
                )
                if begun is None and (seed_frames := bundle.generator.capabilities.seed_frames):
                    start = f"the first {seed_frames / bundle.layout.fps:.2g} s are of a training dance"
                    print_note(aside, f"{start}; --set seed_motion=FILE takes yours")

            def notes(some: Sequence[GeneratedMotion]) -> Sequence[object]:
                prompts = [one.prompt for one in segments or some]
                return bundle.notes(prompts, some, sampling.face_model, seconds)

            for note in notes(motions):
                print_note(aside, note)
            title = page_title([motion.caption for motion in motions], [path.name for path in songs], file)
            write_files(
                out,
                motions,
                wanted,
                title=title,
                note=page_note(len(motions), Path(folder).resolve().name, seed, terms=bundle.terms),
                notes=[notes([motion]) for motion in motions],
                names=None if texts else each([Excerpt.named(path).path.stem for path in songs]),
                figure=posing,
                made_from=None if seed_motion is None else Path(str(seed_motion)),
                say=partial(say, aside),
            )


def formats_of(formats: str | None) -> list[str]:
    """The formats of `--format`, in its words; the default ones without."""
    from motionloom.pipeline.inference.outputs import require_formats

    if formats is None:
        return default_formats()
    wanted = [name.strip() for name in formats.split(",") if name.strip()]
    require_formats(wanted)
    return wanted


def print_note(console: Console, note: object) -> None:
    """Print what a person should know of a motion, in yellow."""
    say(console, f"note: {note}", "yellow")


def write_files(
    out: Path, motions: Sequence[GeneratedMotion], formats: Sequence[str], **options: Any
) -> None:
    """Write motions as `write_motions` does and list the files."""
    from motionloom.pipeline.inference.outputs import write_motions

    console, aside = make_console(), make_console(aside=True)
    paths = write_motions(out, motions, formats, **options)
    for path in paths:
        say(console, str(path))
    if "html" in formats:
        say(aside, f"watch it in a browser: {(out / 'index.html').resolve()}")
