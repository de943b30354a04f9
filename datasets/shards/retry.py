"""Repeating requests that failed in a way that may pass, and reporting plainly those that will not.

Server errors (5xx), timeouts, broken connections and cut answers are tried again after growing random pauses;
a refusal (401, 403), a missing file (404) or another 4xx is an error at once.
"""

from __future__ import annotations

import errno
import random
import time
from collections.abc import Callable
from typing import TypeVar

from motionloom.datasets.schema import UserError

ATTEMPTS = 8
FIRST_PAUSE, LONGEST_PAUSE = 0.2, 15.0
"""Seconds between tries: doubled each time, at random between half and whole."""

_LIBRARIES = {"aiohttp", "aiobotocore", "botocore", "fsspec", "s3fs", "urllib3"}
_ABSENT = "no such file on the server"

T = TypeVar("T")


class MissingFileError(UserError):
    """A data set has no file of that name."""


def persist(what: str, action: Callable[[], T]) -> T:
    """Run `action`, again after failures that may pass; `UserError` naming `what` when it stays refused."""
    failure: BaseException = OSError("never tried")
    for attempt in range(ATTEMPTS):
        if attempt:
            pause = min(FIRST_PAUSE * 2 ** (attempt - 1), LONGEST_PAUSE)
            # Not the global generator: a retry must not shift the run's own random draws.
            time.sleep(pause * random.SystemRandom().uniform(0.5, 1.0))
        try:
            return action()
        except Exception as error:
            if isinstance(error, UserError) or not _from_outside(error):
                raise
            refusal = _refusal(error)
            if isinstance(error, FileNotFoundError) or refusal == _ABSENT:
                raise MissingFileError(f"{what}: {_ABSENT}") from None
            if refusal is not None:
                raise UserError(f"{what}: {refusal}") from None
            failure = error
    reason = " ".join(str(failure).split()) or type(failure).__name__
    raise UserError(f"{what}: {reason[:300]} (tried {ATTEMPTS} times)") from None


def _from_outside(error: Exception) -> bool:
    """Whether an error is the network's or the disk's, not a mistake in a program."""
    return isinstance(error, OSError) or type(error).__module__.partition(".")[0] in _LIBRARIES


def _refusal(error: Exception) -> str | None:
    """Why repeating cannot help, or None when it may."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "the disk of the cache folder is full; free space or lower the cache's gigabytes"
    if isinstance(error, TimeoutError):
        return None
    status = _status(error)
    if isinstance(error, PermissionError) or status in (401, 403):
        return (
            "the server refuses access; set the credentials in the environment (AWS_ACCESS_KEY_ID and "
            "AWS_SECRET_ACCESS_KEY, or AWS_PROFILE) and check that they may read here"
        )
    if "Credentials" in type(error).__name__ or type(error).__name__ in (
        "ProfileNotFound",
        "TokenRetrievalError",
    ):
        return f"no usable credentials in the environment ({error})"
    if status in (404, 410):
        return _ABSENT
    if status is not None and 400 <= status < 500 and status not in (408, 425, 429):
        return f"the server refuses the request (HTTP {status}: {' '.join(str(error).split())[:200]})"
    return None


def _status(error: BaseException | None) -> int | None:
    """HTTP status behind an error or one of its causes."""
    while error is not None:
        status = getattr(error, "status", None)
        response = getattr(error, "response", None)
        if isinstance(response, dict):
            status = response.get("ResponseMetadata", {}).get("HTTPStatusCode", status)
        if isinstance(status, int):
            return status
        error = error.__cause__ or error.__context__
    return None
