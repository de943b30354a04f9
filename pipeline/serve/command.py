"""`motionloom serve`: a model as a page and an API, until Ctrl-C."""

from __future__ import annotations

import os
import socket
from contextlib import closing
from pathlib import Path
from types import FrameType

import numpy as np
import uvicorn
from rich.console import Console

from motionloom.datasets.audio.features import beats
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.generation import StreamingGenerator
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.shipped_models import model_folder, say_model
from motionloom.pipeline.serve.app import Site, is_loopback
from motionloom.pipeline.serve.requests import ServeConfig
from motionloom.pipeline.serve.work import Worker

_LAST = 5
"""Seconds that open requests have to end in when the server stops."""


def serve(folder: Path, config: ServeConfig, *, device: str = "auto", console: Console) -> None:
    """Serve a run folder, an exported one or a model of the package; returns after Ctrl-C."""
    if not model_folder(folder).is_dir():
        MotionModel.from_pretrained(folder)  # says what is there instead
    with closing(listen(config)) as place:
        model = MotionModel.from_pretrained(folder, device=device)
        if (taken := say_model(folder)) is not None:
            console.print(taken, markup=False, highlight=False, soft_wrap=True)
        warm(model)
        worker = Worker(config.waiting)
        host, port = place.getsockname()[:2]
        shown = f"[{host}]" if ":" in host else host
        if not is_loopback(config.host):
            console.print(
                f"[yellow]others can reach this server: it listens at {shown}, without a password and in "
                f"plain text; leave --host out to keep it to this machine[/]",
                soft_wrap=True,
            )
        console.print(f"{folder.resolve().name}: http://{shown}:{port}/ (Ctrl-C stops)", soft_wrap=True)
        site = Site(model, config, worker, folder.resolve().name)
        try:
            server_of(site, worker).run([place])
        except KeyboardInterrupt:  # uvicorn passes it on when all is closed
            pass
        finally:
            worker.stop()
    console.print("stopped")


def listen(config: ServeConfig) -> socket.socket:
    """The address, taken before a model is loaded; `UserError` where that is impossible."""
    where = f"{config.host} port {config.port}"
    try:
        kind = socket.getaddrinfo(config.host, config.port, type=socket.SOCK_STREAM)[0][0]
        place = socket.create_server((config.host, config.port), family=kind, backlog=1024)
    except OSError as error:
        reason = (os.strerror(error.errno) if error.errno and error.errno > 0 else str(error)).lower()
        raise UserError(f"{where}: {reason}; choose another --port, or 0 for a free one") from None
    place.setblocking(False)
    return place


def warm(model: MotionModel) -> None:
    """Load what is loaded at the first use, so that the first request does not wait for it."""
    generator = model.bundle.generator
    if "text" in generator.modalities:
        if isinstance(generator, StreamingGenerator):
            next(model.stream("a person stands", seconds=1.0))
        else:
            model.generate(["a person stands"])
    if "audio" in generator.modalities:
        rate = 22_050
        clicks = (np.arange(4 * rate) % (rate // 2) < 100).astype(np.float32)
        beats(clicks, rate)


def server_of(site: Site, worker: Worker) -> uvicorn.Server:
    """What speaks HTTP for a site."""
    config = uvicorn.Config(
        site.app,
        http="h11",
        ws="none",
        lifespan="off",
        log_level="error",
        access_log=False,
        server_header=False,
        date_header=False,
        timeout_keep_alive=10,
        timeout_graceful_shutdown=_LAST,
        proxy_headers=False,
    )
    return _Server(config, worker)


class _Server(uvicorn.Server):
    """Answers those that wait before it goes."""

    def __init__(self, config: uvicorn.Config, worker: Worker) -> None:
        super().__init__(config)
        self._worker = worker

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """At the first signal: nothing new is begun."""
        self._worker.stop()
        return super().handle_exit(sig, frame)
