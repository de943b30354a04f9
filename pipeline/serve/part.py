"""What a package adds to the page and the API of `motionloom serve`.

    # my_package/served.py
    register(ServedPart("mine", files("my_package") / "web", open_mine))

    # my_package/table.py, which the entry point names
    declare("part of the server", {"mine": "my_package.served"})

Of the folder `web`, each `.js` and `.css` is served from memory: the styles after the page's own, the scripts
under `/assets/`. The page begins `mine.js` by its `begin(page)` (`web/serve.js` says what a page gives and
expects), and holds the markup of `mine.html`; nodes of it with `data-in="save"` are moved into `#save`.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from importlib.resources.abc import Traversable
from typing import Any, Protocol, TypeVar

from starlette.requests import Request
from starlette.responses import Response

from motionloom.datasets.base.register import Table
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.serve.requests import Answer, Asked, Motions, ServeConfig

A = TypeVar("A", bound=Asked)


class Host(Protocol):
    """What a server lends to its parts."""

    model: MotionModel
    config: ServeConfig
    motions: Motions
    """The motions used last, by the names that clients have."""

    async def read(self, http: Request, kind: type[A]) -> A:
        """The JSON of a request."""

    def upload(self, http: Request, what: str, megabytes: float) -> AbstractAsyncContextManager[bytes]:
        """The body of a request, `what` for messages, of at most so many megabytes."""

    async def respond(self, make: Callable[[], Answer]) -> Response:
        """The answer that the model's thread makes when its turn comes; 429 where too many wait."""


@dataclass(frozen=True)
class OpenPart:
    """A part of a server with its model."""

    posts: Mapping[str, Callable[[Request], Awaitable[Response]]]
    """What POST to a path does, such as "/api/edit"."""
    facts: Mapping[str, Any]
    """For the page: the part's entry in the answer of `/api/info`."""


@dataclass(frozen=True)
class ServedPart:
    """One part, opened once a server."""

    name: str
    web: Traversable
    open: Callable[[Host], OpenPart]


SERVED: Table[ServedPart] = Table(ServedPart, "part of the server")
