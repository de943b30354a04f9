"""`motionloom serve`: a page to type captions and watch, and a JSON API."""

from __future__ import annotations

from typing import Annotated

import typer

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.register import register
from motionloom.pipeline.cli.options import Device, ModelFolder, Rig, fields_of, set_option
from motionloom.pipeline.contract.command import Command
from motionloom.pipeline.launch.console import make_console


def serve(
    run_folder: ModelFolder,
    host: Annotated[
        str, typer.Option(help="Address to listen at; others can reach all but loopback.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port; 0 takes a free one.")] = 8000,
    rig: Rig = None,
    sets: Annotated[
        list[str] | None,
        set_option(
            "A limit: waiting (requests that wait for the model), max_seconds (of a motion), max_sound_mb, "
            "...; or allow_hosts=[NAME], names by which the server is reached."
        ),
    ] = None,
    device: Device = "auto",
) -> None:
    """A page to type captions, drop music and watch, and a JSON API, on this machine.

    Example: `motionloom serve synthetic`

    Example: `motionloom serve runs/humantomato-tiny`

    Example: `motionloom serve inbetween --rig hero.vrm`

    Example: `motionloom serve my-model --port 0 --set max_seconds=10`
    """
    from motionloom.pipeline.serve.requests import ServeConfig

    given = {"host": host, "port": port, "rig": rig, **fields_of(sets, "--set")}
    config = ServeConfig.parse(given, "serve")
    try:
        from motionloom.pipeline.serve.server import serve as run_server
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn"):
            raise
        raise UserError(f"serve needs {error.name}: pip install 'motionloom[serve]'") from None
    run_server(run_folder, config, device=device, console=make_console())


register(Command("serve", serve))
