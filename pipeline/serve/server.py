"""What answers for a site: the address, HTTP, so many connections, and the end at Ctrl-C."""

from __future__ import annotations

import asyncio
import os
import socket
from types import FrameType
from typing import Protocol

import uvicorn
from rich.console import Console
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from motionloom.datasets.schema import UserError
from motionloom.pipeline.serve.guard import is_loopback
from motionloom.pipeline.serve.requests import ServeConfig
from motionloom.pipeline.serve.work import Worker

_LAST = 5
"""Seconds that open requests have to end in when the server stops."""


class Served(Protocol):
    """What a server answers with."""

    @property
    def app(self) -> ASGIApp: ...

    @property
    def config(self) -> ServeConfig: ...


def run_site(site: Served, place: socket.socket, worker: Worker, name: str, console: Console) -> None:
    """Say where a site is, and answer until Ctrl-C."""
    host, port = place.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    if not is_loopback(site.config.host):
        console.print(
            f"[yellow]others can reach this server: it listens at {shown}, without a password and in "
            f"plain text; leave --host out to keep it to this machine[/]",
            soft_wrap=True,
        )
    console.print(f"{name}: http://{shown}:{port}/ (Ctrl-C stops)", soft_wrap=True)
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
        place = socket.create_server((config.host, config.port), family=kind, backlog=config.connections)
    except OSError as error:
        reason = (os.strerror(error.errno) if error.errno and error.errno > 0 else str(error)).lower()
        raise UserError(f"{where}: {reason}; choose another --port, or 0 for a free one") from None
    place.setblocking(False)
    return place


def server_of(site: Served, worker: Worker) -> uvicorn.Server:
    """What speaks HTTP for a site."""
    config = uvicorn.Config(
        site.app,
        http=connection_of(site.config),
        backlog=_most(site.config),  # so many are also accepted at a time, before any can be refused
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


def connection_of(config: ServeConfig) -> type[H11Protocol]:
    """What reads a connection: so many at a time, and closed where headers do not come in time. One more
    takes the place of the one that has asked for nothing the longest.
    """
    most, patience = _most(config), config.patience

    class Connection(H11Protocol):
        _late: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            if len(self.connections) >= most:
                idle = [one for one in self.connections if isinstance(one, Connection) and one._idle()]
                if not idle:
                    transport.abort()
                    return
                longest = min(idle, key=lambda one: one._since)
                self.connections.discard(longest)
                longest.transport.abort()
            super().connection_made(transport)
            self._since = self.loop.time()
            self._late = self.loop.call_later(patience, self._drop)

        def on_response_complete(self) -> None:
            super().on_response_complete()
            self._since = self.loop.time()

        def data_received(self, data: bytes) -> None:
            if self._late is None and not self._asked():
                self._late = self.loop.call_later(patience, self._drop)
            super().data_received(data)
            if self._late is not None and self._asked():
                self._late.cancel()
                self._late = None

        def connection_lost(self, exc: Exception | None) -> None:
            if self._late is not None:
                self._late.cancel()
            if self in self.connections:
                super().connection_lost(exc)

        def _asked(self) -> bool:
            """Whether a request's headers are here, and it is being answered."""
            return self.cycle is not None and not self.cycle.response_complete

        def _idle(self) -> bool:
            """Whether nothing is asked, and all that was answered has gone out."""
            return not self._asked() and not self.transport.get_write_buffer_size()

        def _drop(self) -> None:
            self._late = None
            if not self._asked():
                self.transport.close()

    return Connection


def _most(config: ServeConfig) -> int:
    """Connections at a time: a quarter of what this process may have open at most."""
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        return min(config.connections, 128)
    return min(config.connections, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 4)


class _Server(uvicorn.Server):
    """Answers those that wait before it goes."""

    def __init__(self, config: uvicorn.Config, worker: Worker) -> None:
        super().__init__(config)
        self._worker = worker

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """At the first signal: nothing new is begun."""
        self._worker.stop()
        return super().handle_exit(sig, frame)
