"""Captions in a folder: one .txt file a clip, with plain lines or lines of HumanML3D's grammar."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from motionloom.datasets.convert.common.caption_text import Form, Record, read_text, wrong
from motionloom.datasets.convert.common.humanml_text import parse_caption
from motionloom.datasets.schema import Caption, UserError

_NUMBER = r"\s*(?:nan|[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|[-+]?\.\d+)\s*"
_HUMANML = re.compile(rf"[^#].*#.*#{_NUMBER}#{_NUMBER}")


def folder_records(folder: Path) -> Iterator[Record]:
    """A record for each file, named by its path without `.txt`.

    The folder is in HumanML3D's grammar when the first line of any file is: then all lines must be.
    """
    paths = sorted(p for p in folder.rglob("*.txt") if p.is_file() and not p.name.startswith("."))
    if not paths:
        others = sorted(p.name for p in folder.iterdir() if p.is_file())[:3]
        seen = f" (it holds {', '.join(others)}; name the file itself)" if others else ""
        raise UserError(f"{folder}: no .txt file in it{seen}; expected {Form.PLAIN.value}")
    texts = {path: read_text(path).split("\n") for path in paths}
    firsts = (next((line for line in lines if line.strip()), "") for lines in texts.values())
    humanml = any(_HUMANML.fullmatch(line) for line in firsts)
    for path, lines in texts.items():
        name = path.relative_to(folder).as_posix().removesuffix(".txt")
        made = _humanml(path, lines) if humanml else [line for line in lines if line.strip()]
        yield Record(
            {"id": name, "captions": made},
            lambda _, path=path: f"{path}:1:1",  # type: ignore[misc]
            Form.HUMANML if humanml else Form.PLAIN,
        )


def _humanml(path: Path, lines: list[str]) -> list[Caption]:
    made = []
    for number, line in enumerate(lines, start=1):
        if line.strip():
            try:
                made.append(parse_caption(line, seconds=None, source="captions"))
            except UserError as error:
                raise wrong(f"{path}:{number}:{_column(line)}", str(error), Form.HUMANML) from None
    return made


def _column(line: str) -> int:
    """Where a line leaves the grammar: its end for a missing field, else the first field that is wrong."""
    fields = line.split("#")
    if len(fields) < 4:
        return len(line) + 1
    start = len(line) - len(fields[-1]) - len(fields[-2]) - 1
    for field, offset in ((fields[-2], start), (fields[-1], start + len(fields[-2]) + 1)):
        if not re.fullmatch(_NUMBER, field):
            return offset + 1
    return 1
