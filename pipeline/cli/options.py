"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ModelFolder = Annotated[Path, typer.Argument(help="A run folder (runs/NAME), or a folder made by export.")]
RunFolder = Annotated[Path, typer.Argument(help="A run folder (runs/NAME).")]
Sets = Annotated[
    list[str] | None,
    typer.Option("--set", "-s", help="Override one value: stage.field=value. May be repeated."),
]
Device = Annotated[
    str, typer.Option(help="auto (a GPU if there is one; stages go by the recipe), cpu, cuda or cuda:N.")
]
