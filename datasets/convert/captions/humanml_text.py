"""HumanML3D's caption lines, also used by Motion-X for its `humanml/` clips: `caption#tokens#start#end`.

Choices:
- A line is read from the right, because captions may hold `#`. When the tokens hold one too (`#/SYM`), the
  split that makes every token `word/POS` is taken.
- `nan` is 0.0, as in the published loaders, and 0.0#0.0, as any segment without length, means the whole clip
  (`end` None).
- A segment that is wrong or reaches more than half a second past the clip is reported and left out: which
  frames it describes is unknown. Less than that is rounding, and the end is the clip's.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import number
from motionloom.datasets.base.records import Caption
from motionloom.datasets.convert.common.config import END_TOLERANCE
from motionloom.datasets.convert.common.files import read_text_file
from motionloom.datasets.text.clean import clean_caption, usable_caption

_TOKEN = re.compile(r"\S+/[A-Z]+")
_MOST_FIELDS = 100
"""Between the `#` of a line. Each may be where the tokens begin, so the time to find them grows with both."""


def read_humanml_captions(
    path: Path, *, seconds: float | None, source: str = "humanml3d", name: str | None = None
) -> tuple[list[Caption], list[str]]:
    """The good captions of one file in their order, and what is wrong with the other lines, `line N: ...`.

    `seconds` is the clip's length; None leaves ends past the clip unchecked. Blank lines say nothing.
    `UserError` when the file cannot be read or is not UTF-8 (`name` stands for its path there).
    """
    captions: list[Caption] = []
    problems: list[str] = []
    for row, line in enumerate(read_text_file(path, name).split("\n"), start=1):
        if not line.strip():
            continue
        try:
            captions.append(parse_caption(line, seconds=seconds, source=source))
        except UserError as error:
            problems.append(f"line {row}: {error}")
    return captions, problems


def parse_caption(line: str, *, seconds: float | None, source: str = "humanml3d") -> Caption:
    """Return the caption of one line; `UserError` says what is wrong with it."""
    fields = line.split("#")
    if not 4 <= len(fields) <= _MOST_FIELDS:
        raise UserError(f"{len(fields)} of the 4 fields caption#tokens#start#end")
    text, tokens = _caption_and_tokens(fields[:-2])
    start = _seconds(fields[-2], "start")
    end = _seconds(fields[-1], "end")
    cleaned = clean_caption(text)
    if not usable_caption(text):
        raise UserError(f"no usable caption ('{cleaned[:60]}')" if cleaned else "the caption is empty")
    if start == end:
        return Caption(text=cleaned, source=source, tokens=tokens)
    if end < start:
        raise UserError(f"the segment ends at {end:g} s, not after its start at {start:g} s")
    if seconds is not None:
        if start >= seconds or end > seconds + END_TOLERANCE:
            what = f"starts at {start:g} s" if start >= seconds else f"ends at {end:g} s"
            raise UserError(f"the segment {what}, beyond the clip of {seconds:.2f} s")
        end = min(end, seconds)
    return Caption(text=cleaned, start=start, end=end, source=source, tokens=tokens)


def _caption_and_tokens(fields: list[str]) -> tuple[str, list[str] | None]:
    for last in range(len(fields) - 1, 0, -1):
        tokens = [*map(sys.intern, "#".join(fields[last:]).split())]  # the same few thousand in all clips
        if all(_TOKEN.fullmatch(token) for token in tokens):
            return "#".join(fields[:last]), tokens or None
    tokens = [token for token in fields[-1].split() if _TOKEN.fullmatch(token)]
    if not tokens:
        raise UserError(f"'{fields[-1].strip()[:40]}' holds no word/POS tokens; is a field missing?")
    return "#".join(fields[:-1]), tokens


def _seconds(field: str, what: str) -> float:
    text = field.strip()
    return 0.0 if text.lower() == "nan" else number(text, what, 1e6)
