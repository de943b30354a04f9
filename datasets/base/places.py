"""Names of folders and of models on the hub: which of both is meant, and what is there beside a wrong one."""

from __future__ import annotations

import difflib
import os
import re
import socket
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

from motionloom.datasets.base.config import require_local
from motionloom.datasets.base.errors import UserError

_HUB = re.compile(r"[A-Za-z0-9][\w.-]*(/[A-Za-z0-9][\w.-]*)?")
_ENDPOINT = "https://huggingface.co"
_SHOWN = 5


def no_such_folder(folder: Path) -> str:
    """One sentence about a folder that is not there, with the nearest names that are. Raises for a URL."""
    require_local(folder)
    place = folder
    name = folder.name
    while not place.is_dir() and place != place.parent:
        place, name = place.parent, place.name
    try:
        names = sorted(path.name for path in place.iterdir() if path.is_dir() and path.name[0] != ".")
    except OSError:
        names = []
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    if near:
        return f"{folder}: no such folder; did you mean {place / near[0]}?"
    where = "here" if place == Path() else f"in {place}"
    if not names:
        return f"{folder}: no such folder, and none is {where}"
    more = ", ..." if len(names) > _SHOWN else ""
    return f"{folder}: no such folder; {where}: {', '.join(names[:_SHOWN])}{more}"


def means_folder(name: str) -> bool:
    """Whether a name can only be a folder's: it is no hub name, or begins with a folder that is here."""
    if not _HUB.fullmatch(name):
        return True
    owner, slash, _ = name.partition("/")
    return bool(slash) and Path(owner).is_dir()


def require_hub_name(name: str) -> None:
    """Refuse, at once, a name that the hub need not be asked for; no folder of this name is here."""
    if means_folder(name):
        raise UserError(no_such_folder(Path(name).expanduser()))


def hub_is_away() -> bool:
    """Whether the hub cannot be reached, found without its library's minute of retries.

    Behind a proxy this machine need not know the hub's name, so there only the library can tell.
    """
    endpoint = urlsplit(os.environ.get("HF_ENDPOINT", _ENDPOINT))
    if urllib.request.getproxies().get(endpoint.scheme):
        return False
    try:
        socket.getaddrinfo(endpoint.hostname, endpoint.port or 443)
    except OSError:
        return True
    return False
