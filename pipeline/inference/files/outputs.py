"""Motions to files: all formats of `writers.py` in a folder, one motion to one file, or into a notebook."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterable, Sequence
from html import escape
from pathlib import Path

from motionloom.datasets.audio.features import beats
from motionloom.datasets.base.errors import UserError, nearest
from motionloom.datasets.base.files import write_text
from motionloom.datasets.base.register import discover
from motionloom.pipeline.inference.files.display_figure import FigureOptions, shown
from motionloom.pipeline.inference.files.motion_data import MotionData
from motionloom.pipeline.inference.files.writers import WRITERS, OutputClip, Outputs, cell_of, writer_for
from motionloom.pipeline.render.sound import Score
from motionloom.pipeline.render.viewer import viewer_page
from motionloom.pipeline.store.artifact import Terms
from motionloom.pipeline.store.files import new_files, require_folder

WRITTEN = ".motionloom"
"""Names of the files that are beside it; the next motions take their place."""


def file_stem(number: int, name: str) -> str:
    """A safe file name: number and the first words of a caption or a song, in any script."""
    plain = unicodedata.normalize("NFKC", name).lower()
    # Vowel signs of Indian and other scripts are marks, which are no \w.
    kept = "".join(letter if unicodedata.category(letter)[0] in "LMN" else " " for letter in plain)
    words = "-".join(kept.split())[:48].strip("-")
    return f"{number:02d}-{words or 'motion'}"


def write_motions(
    folder: Path | str,
    motions: Iterable[MotionData],
    formats: Sequence[str],
    *,
    title: str,
    note: str = "",
    scores: Sequence[Score] | None = None,
    names: Sequence[str] | None = None,
    labels: Sequence[str] | None = None,
    notes: Sequence[Sequence[object]] | None = None,
    figure: FigureOptions | None = None,
    made_from: Path | None = None,
    say: Callable[[str], None] | None = None,
) -> list[Path]:
    """Write every motion in every format; the page holds all of them. Returns the paths.

    What was written there before is removed once all of it lies there, but for the file that the motions are
    `made_from`. `title` and `note` are the page's. `scores`, one for each motion, are sound, beats and
    segments for the page; without them each motion comes with what drove it. `names` are what files are
    called after, instead of the captions; `labels` are what the page says above each, `notes` the lines
    below. `figure` says how the shown figure follows the generated joints, and `say` is given a line on each
    motion that it is far from.
    """
    folder = Path(folder)
    motions = list(motions)
    require_folder(folder)
    require_formats(formats)
    options = figure or FigureOptions()
    scores = [score_of(motion) for motion in motions] if scores is None else scores
    writers = [(name, writer) for name, writer in WRITERS.items() if name in formats]
    for name, writer in writers:
        if writer.needs_face and any(motion.face is None for motion in motions):
            raise UserError(f"this model makes no face: leave the format {name} out")
    names = [motion.caption for motion in motions] if names is None else names
    out: list[Path] = []
    clips: list[OutputClip] = []
    said: dict[str, None] = {}
    with new_files(folder) as new:
        for number, (motion, score) in enumerate(zip(motions, scores, strict=True)):
            name = file_stem(number, names[number])
            label = "generated" if labels is None else labels[number]
            lines = () if notes is None else notes[number]
            clips.append(OutputClip(shown(motion, options), score, options, label, "arkit" in formats, lines))
            if say is not None and (remark := clips[-1].shown.remark):
                say(f"{name}: {remark}")
            for _, writer in writers:
                if writer.alone:
                    out.append(new / f"{name}{writer.suffix}")
                    lacks = writer.write(out[-1], Outputs(clips[-1:], title, note)) or ()
                    said.update(dict.fromkeys(lacks))
        for _, writer in writers:
            if writer.together and (len(clips) > 1 or not writer.alone):
                out.append(new / writer.together)
                said.update(dict.fromkeys(writer.write(out[-1], Outputs(clips, title, note)) or ()))
        if say is not None:
            for line in said:
                say(line)
        paths = [folder / path.name for path in out]
        if made_from is not None and any(path.exists() and path.samefile(made_from) for path in paths):
            raise UserError(f"{made_from}: would be replaced by a motion made from it; choose another folder")
    for path in set(_written(folder)) - set(paths):
        if made_from is None or not path.samefile(made_from):
            path.unlink()
    write_text(folder / WRITTEN, "".join(f"{path.name}\n" for path in paths))
    return paths


def require_formats(formats: Sequence[str]) -> None:
    """Refuse names of formats that there are not, and none at all."""
    discover()
    if not formats or isinstance(formats, str):
        raise UserError(f"formats {formats!r}: give a list of some; known: {', '.join(WRITERS)}")
    for name in formats:
        if name not in WRITERS:
            raise UserError(f"format {name}: no such format{nearest(name, list(WRITERS))}")


def _written(folder: Path) -> list[Path]:
    """The files that motions before left here, and no other ones."""
    written = folder / WRITTEN
    known = {name for writer in WRITERS.values() for name in (writer.suffix, writer.together) if name}
    names = written.read_text(encoding="utf-8").splitlines() if written.is_file() else []
    paths = [folder / name for name in names if Path(name).name == name and name.endswith(tuple(known))]
    return [path for path in paths if path.is_file()]


def save(path: Path, motion: MotionData, note: str = "") -> None:
    """Write one file, of the format that its ending names; `note` is a page's."""
    writer = writer_for(path)
    if not path.parent.is_dir():
        raise UserError(f"{path}: there is no folder {path.parent}; make it first")
    writer.write(path, Outputs([clip_of(motion)], page_title([motion.caption]), note))


def clip_of(motion: MotionData) -> OutputClip:
    """The motion with all that drove it."""
    options = FigureOptions()
    return OutputClip(shown(motion, options), score_of(motion), options)


def frame_of(motion: MotionData, height: int = 480) -> str:
    """The viewer page within an `iframe` whose script runs apart from all around it."""
    page = viewer_page([cell_of(clip_of(motion))], page_title([motion.caption]))
    return (
        f'<iframe sandbox="allow-scripts" title="{escape(motion.caption)}" loading="lazy" '
        f'srcdoc="{escape(page)}" style="width: 100%; height: {height}px; border: 0"></iframe>'
    )


def score_of(motion: MotionData) -> Score:
    """The music that a motion was driven by, its beats, and the segments; beats only where music drove."""
    sound = motion.prompt.sound
    if sound is None:
        return Score(segments=motion.segments)
    found = list(motion.beats or ())
    if motion.beats is None:
        found = [float(time) for time in beats(sound.samples, sound.rate)]
    if motion.segments:
        spans = [(one.start, one.end) for one in motion.segments if one.kind == "music"]
        found = [time for time in found if any(start <= time < end for start, end in spans)]
    return Score(sound=sound, beats=found, segments=motion.segments)


def page_title(captions: Sequence[str], sounds: Sequence[str] = (), script: Path | None = None) -> str:
    """The script, or the words and the music where all motions have the same, else how many there are."""
    if script is not None:
        return f"Script {script.name}"
    words = list(dict.fromkeys(filter(None, captions)))
    music = list(dict.fromkeys(sounds))
    if len(words) > 1 or len(music) > 1:
        return f"{len(captions)} motions"
    return ", to ".join(words + music) or "Motion"


def page_note(
    count: int, model: str, seed: int, remarks: Sequence[object] = (), terms: Terms | None = None
) -> str:
    """Who made them, in one line, one for each thing to know of them, and the credits of the model's data."""
    remarks = [*remarks, *(terms.credits if terms else ())]
    made = f"{count} {'motion' if count == 1 else 'motions'} generated by {model}, seed {seed}"
    return "\n".join([made, *map(str, remarks)])
