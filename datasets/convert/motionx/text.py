"""Texts of Motion-X: captions of clips, words about the face, and sentences about single frames.

`humanml/` holds HumanML3D's caption lines, whose segments are in seconds of the 30 fps motion (HumanTOMATO's
loader takes 20). Everywhere else a file is plain sentences, one a line, some of them only the clip's name.
"""

from __future__ import annotations

import json
from pathlib import Path

from motionloom.datasets.convert.common.files import read_text_file
from motionloom.datasets.convert.common.humanml_text import read_humanml_captions
from motionloom.datasets.schema import Caption, UserError
from motionloom.datasets.text.clean import clean_caption, usable_caption

HUMANML = "humanml"
SOURCE = "motionx"


def read_motionx_captions(
    path: Path, *, subset: str, seconds: float, name: str
) -> tuple[list[Caption], list[str]]:
    """The usable captions of one clip, and what is wrong with the other lines (`line N: ...`).

    `UserError` when the file cannot be read or is not UTF-8; `name` stands for it in messages.
    """
    if subset == HUMANML:
        return read_humanml_captions(path, seconds=seconds, source=SOURCE, name=name)
    return read_sentences(path, source=SOURCE, name=name)


def read_sentences(path: Path, *, source: str, name: str) -> tuple[list[Caption], list[str]]:
    """Plain sentences, one a line, each once; and the lines that say nothing."""
    found: dict[str, Caption] = {}
    problems: list[str] = []
    for number, line in enumerate(read_text_file(path, name).split("\n"), start=1):
        if not line.strip():
            continue
        text = clean_caption(line)
        if usable_caption(line):
            found.setdefault(text, Caption(text=text, source=source))
        else:
            problems.append(f"line {number}: no usable caption ('{text[:60]}')")
    return list(found.values()), problems


def read_frame_texts(path: Path, *, source: str, frames: int, fps: float, name: str) -> list[Caption]:
    """`{"frame": sentence}` as captions of the frames' seconds; equal sentences in a row become one.

    Frames beyond the clip are left out: the sentences were made for the authors' own cut of it. `UserError`
    for anything but such a table.
    """
    try:
        table = json.loads(read_text_file(path, name))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{name}: not valid JSON ({error})") from None
    if not isinstance(table, dict):
        raise UserError(f"{name}: expected an object of frame numbers and sentences")
    sentences: dict[int, str] = {}
    for key, text in table.items():
        if not (key.isdecimal() and key.isascii()) or not isinstance(text, str):
            raise UserError(f"{name}: '{key[:20]}' is not a frame number with a sentence")
        if int(key[:18]) < frames and usable_caption(text):
            sentences[int(key)] = clean_caption(text)
    made: list[Caption] = []
    for frame, text in sorted(sentences.items()):
        start, end = frame / fps, (frame + 1) / fps
        if made and made[-1].text == text and made[-1].end == start:
            made[-1] = made[-1].model_copy(update={"end": end})
        else:
            made.append(Caption(text=text, start=start, end=end, source=source))
    return made
