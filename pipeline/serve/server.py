"""`motionloom serve`: a model as a page and an API, until Ctrl-C. HTTP and its limits are uvicorn's."""

from __future__ import annotations

import os
import socket
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, cast

import uvicorn
from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.shipped_models import find_model
from motionloom.pipeline.serve.app import Site
from motionloom.pipeline.serve.guard import HEADERS, Connection, is_loopback
from motionloom.pipeline.serve.requests import ServeConfig

_GRACE = 5
"""Seconds that open requests have to end in when the server stops."""


def serve(folder: Path | str, config: ServeConfig, *, device: str = "auto", console: Console) -> None:
    """Serve a run folder, an exported one, a model of the package or one of the hub, until Ctrl-C."""
    place = find_model(folder)
    # The address is taken before the model is loaded, so that a taken port is reported at once.
    with closing(listen(config)) as listener:
        model = MotionModel.from_pretrained(place, device=device)
        name = Path(folder).resolve().name
        site = Site(model, config, name)
        server = server_of(site)
        host, port = listener.getsockname()[:2]
        address = f"[{host}]" if ":" in host else host
        if not is_loopback(config.host):
            console.print(
                f"[yellow]others can reach this server: it listens at {address}, without a password and in "
                f"plain text, and knows the names of --set allow_hosts; put a proxy before it, or leave "
                f"--host out[/]",
                soft_wrap=True,
            )
        console.print(f"{name}: http://{address}:{port}/ (Ctrl-C stops)", soft_wrap=True)
        try:
            server.run([listener])
        except KeyboardInterrupt:  # uvicorn passes it on when all is closed
            pass
        finally:
            site.stop()
        console.print("stopped")


def listen(config: ServeConfig) -> socket.socket:
    """Return a socket bound to the address; `UserError` where that is impossible."""
    try:
        kind = socket.getaddrinfo(config.host, config.port, type=socket.SOCK_STREAM)[0][0]
        listener = socket.create_server((config.host, config.port), family=kind, backlog=config.connections)
    except OSError as error:
        reason = (os.strerror(error.errno) if error.errno and error.errno > 0 else str(error)).lower()
        raise UserError(
            f"{config.host} port {config.port}: {reason}; choose another --port, or 0 for a free one"
        ) from None
    listener.setblocking(False)
    return listener


def server_of(site: Site) -> uvicorn.Server:
    """Return the HTTP server of a site."""
    config = uvicorn.Config(
        site.app,
        http=cast(Any, partial(Connection, patience=site.config.patience)),
        ws="none",
        lifespan="off",
        log_level="error",
        access_log=False,
        server_header=False,
        date_header=False,
        proxy_headers=False,
        headers=list(HEADERS.items()),
        limit_concurrency=site.config.connections + 1,  # uvicorn counts the connection that asks
        timeout_keep_alive=10,
        timeout_graceful_shutdown=_GRACE,
    )
    return uvicorn.Server(config)
