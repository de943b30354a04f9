"""`motionloom generate`: motions to files."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.cli.motions import formats_of, print_note, write_files
from motionloom.pipeline.cli.options import At, Device, ModelFolder, Rig, Settings, settings_of
from motionloom.pipeline.inference.files.writers import figure_keys, figure_options, formats_help
from motionloom.pipeline.launch.console import make_console, say
from motionloom.pipeline.store.files import require_folder

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
    beats: Annotated[
        str | None,
        typer.Option(
            help="Its beats: a file of seconds, tempo@first beat as 120@0.35, or half, double, shift."
        ),
    ] = None,
    samples: Annotated[int, typer.Option(min=1, help="Motions of each caption, sound or script.")] = 1,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")] = Path("motions"),
    formats: Annotated[str | None, typer.Option("--format", "-f", help=formats_help())] = None,
    seconds: Annotated[float | None, typer.Option(help="Length; default: the model decides.")] = None,
    rig: Rig = None,
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

    Example: `motionloom generate dance --audio song.ogg --beats 120@0.35`

    Example: `motionloom generate runs/humantomato-tiny "a person bows" --format glb,html`
    """
    from motionloom.datasets.audio.given_beats import in_words
    from motionloom.datasets.audio.sound import Excerpt
    from motionloom.pipeline.contract.sampling import SamplingConfig
    from motionloom.pipeline.inference.files.outputs import page_note, page_title
    from motionloom.pipeline.inference.model import MotionModel
    from motionloom.pipeline.inference.request import Request, require_words
    from motionloom.pipeline.inference.script import read_music
    from motionloom.pipeline.runs.snapshot import run_at

    fields, figure, more = settings_of(
        settings, SamplingConfig.model_fields, figure_keys(), ("face", "seed_motion")
    )
    if rig is not None:
        figure["rig"] = rig
    wanted = formats_of(formats, figure)
    posing = figure_options(figure, wanted)
    face = more.get("face")
    begun = more.get("seed_motion")
    faces = None if face is None else [str(one) for one in (face if isinstance(face, list) else [face])]
    texts = list(captions or [])
    songs = audio or []
    file = Path(texts.pop(0)) if texts and texts[0].lower().endswith(_SCRIPTS) else None
    # All that needs no model is checked before one is opened.
    if not texts and not songs and file is None:
        raise UserError('give at least one caption, like: motionloom generate RUN "a person waves"')
    if beats is not None and not songs:
        raise UserError("--beats: they are those of a song; name one by --audio song.ogg")
    require_words(texts)
    require_words(faces or (), "face")
    drawn: dict[str, Any] = {"seed": seed, "sampling": SamplingConfig.parse(fields, "--set")}
    require_folder(out)
    sounds = [read_music(path, beats) for path in songs]
    if file is not None:
        if texts or songs or seconds is not None or faces or begun:
            raise UserError(
                f"{file}: a script says everything: leave captions, --audio, --seconds, face and seed_motion "
                f"out"
            )
        request = Request.of_script(file, samples=samples, **drawn)
    else:
        request = Request.of(
            _each(texts, samples),
            face=faces if faces is None or len(faces) == 1 else _each(faces, samples),
            sounds=_each(sounds, samples),
            seconds=seconds,
            seed_motions=None if begun is None else str(begun),
            **drawn,
        )
    aside = make_console(aside=True)  # standard output is the list of files
    with run_at(run_folder, at) as folder:
        model = MotionModel(folder, device)
        motions = model.make(request)
        if begun is None and file is None and (start := model.bundle.generator.capabilities.seed_frames):
            lead = f"the first {start / model.fps:.2g} s are of a training dance"
            print_note(aside, f"{lead}; --set seed_motion=FILE takes yours")
        for path, sound in zip(songs, sounds, strict=True):
            say(aside, f"{path.name}: {in_words(sound)}")
        for note in model.notes(request, motions):
            print_note(aside, note)
        write_files(
            out,
            motions,
            wanted,
            title=page_title([motion.caption for motion in motions], [path.name for path in songs], file),
            note=page_note(len(motions), Path(folder).resolve().name, seed, terms=model.bundle.terms),
            notes=[model.notes(request.alone(row), [motion]) for row, motion in enumerate(motions)],
            names=None if texts else _each([Excerpt.named(path).path.stem for path in songs], samples),
            figure=posing,
            made_from=None if begun is None else Path(str(begun)),
            say=partial(say, aside),
        )


def _each(values: Sequence[Any], samples: int) -> list[Any] | None:
    """Every value so many times; None without any."""
    return [value for value in values for _ in range(samples)] or None
