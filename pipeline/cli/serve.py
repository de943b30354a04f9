"""`motionloom serve`: a page to type captions and watch, on this machine."""

from __future__ import annotations

from typing import Annotated

import typer

from motionloom.datasets.schema import UserError
from motionloom.pipeline.cli.options import Device, ModelFolder
from motionloom.pipeline.launch.console import make_console


def serve(
    run_folder: ModelFolder,
    host: Annotated[
        str, typer.Option(help="Address to listen at; others can reach all but loopback.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port; 0 takes a free one.")] = 8000,
    allow_host: Annotated[
        list[str] | None,
        typer.Option("--allow-host", help="A name by which the server is reached. May be repeated."),
    ] = None,
    waiting: Annotated[int, typer.Option(help="Requests that may wait for the model; more get 429.")] = 32,
    max_seconds: Annotated[float, typer.Option(help="Longest motion.")] = 30.0,
    max_sound_mb: Annotated[float, typer.Option(help="Largest sound file.")] = 20.0,
    device: Device = "auto",
) -> None:
    """A page to type captions, drop music and watch, and a JSON API, on this machine.

    Example: `motionloom serve synthetic`

    Example: `motionloom serve runs/humantomato-tiny`

    Example: `motionloom serve my-model --port 0 --max-seconds 10`
    """
    from motionloom.pipeline.serve.config import ServeConfig

    asked = {
        "host": host,
        "port": port,
        "allow_hosts": tuple(allow_host or ()),
        "waiting": waiting,
        "max_seconds": max_seconds,
        "max_sound_mb": max_sound_mb,
    }
    config = ServeConfig.parse(asked, "serve")
    try:
        from motionloom.pipeline.serve.command import serve as run_server
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn"):
            raise
        raise UserError(f"serve needs {error.name}: pip install 'motionloom[serve]'") from None
    run_server(run_folder, config, device=device, console=make_console())
