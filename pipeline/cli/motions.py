"""The files of motions that a command writes, and what it says of them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from motionloom.pipeline.inference.files.writers import default_formats
from motionloom.pipeline.launch.console import make_console, say

if TYPE_CHECKING:
    from motionloom.pipeline.inference.motion import GeneratedMotion


def formats_of(formats: str | None, options: Collection[str] = ()) -> list[str]:
    """The formats of `--format`, in its words; without, the default ones and those that options are of."""
    from motionloom.pipeline.inference.files.outputs import require_formats

    if formats is None:
        return default_formats(options)
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
    from motionloom.pipeline.inference.files.outputs import write_motions

    console = make_console()
    aside = make_console(aside=True)
    paths = write_motions(out, motions, formats, **options)
    for path in paths:
        say(console, str(path))
    if "html" in formats:
        say(aside, f"watch it in a browser: {(out / 'index.html').resolve()}")
