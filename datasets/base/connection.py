"""Connections by fsspec and its packages: s3fs, gcsfs (`gs:`), adlfs (`az:`), the hub's, aiohttp."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from motionloom.datasets.base.errors import UserError

_CONNECT_SECONDS = 15
_READ_SECONDS = 60


@lru_cache(maxsize=4)
def connect(scheme: str, pid: int, settings: tuple[tuple[str, str], ...]) -> Any:
    """An fsspec file system of this process and environment, without retries of its own (see `persist`)."""
    try:
        import fsspec

        if scheme == "s3":
            import s3fs  # type: ignore[import-untyped]  # noqa: F401 (a missing one is reported by name)

            system = fsspec.filesystem(
                "s3",
                skip_instance_cache=True,
                use_listings_cache=False,
                config_kwargs={
                    "connect_timeout": _CONNECT_SECONDS,
                    "read_timeout": _READ_SECONDS,
                    "retries": {"total_max_attempts": 1},
                    "max_pool_connections": 32,
                },
            )
            system.retries = 1
            return system
        if scheme not in (
            "http",
            "https",
        ):  # they repeat by their own rules, the hub's for as long as it asks
            return fsspec.filesystem(scheme, skip_instance_cache=True)
        import aiohttp

        timeout = aiohttp.ClientTimeout(total=None, connect=_CONNECT_SECONDS, sock_read=_READ_SECONDS)
        return fsspec.filesystem("http", skip_instance_cache=True, client_kwargs={"timeout": timeout})
    except ImportError as error:
        raise UserError(
            f"reading from {scheme}: needs {error.name or error}; pip install "
            f"'motionloom[{scheme if scheme in ('gs', 'az') else 'remote'}]'"
        ) from None
