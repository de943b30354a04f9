"""`motionloom replay`: the step of a crash bundle once more."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from motionloom.pipeline.launch.console import make_console


def replay(
    bundle: Annotated[
        Path, typer.Argument(help="A crash bundle: runs/NAME/stages/STAGE/crash/step_XXXXXXXX.")
    ],
    anomaly: Annotated[
        bool,
        typer.Option(
            "--anomaly", help="Look into the step: torch's anomaly mode, and the first layer that fails."
        ),
    ] = False,
) -> None:
    """Repeat the step in which a training went wrong, from the checkpoint before it.

    The same batches, draws and processes; the run is not touched. Prints the losses, the gradient norms of
    each layer group, and whether it failed again. Exit code 1 if it did.

    Example: `motionloom replay runs/humantomato-tiny/stages/gpt/crash/step_00001234 --anomaly`
    """
    from motionloom.pipeline.runs.replay import replay_crash

    if replay_crash(bundle, anomaly=anomaly, console=make_console()):
        raise typer.Exit(1)
