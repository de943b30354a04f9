"""Two machines with a network of their own between them: namespaces of this one, which need root and `ip`."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def why_not() -> str:
    """Why none can be made here; empty when they can."""
    if os.name != "posix" or os.geteuid() != 0 or shutil.which("ip") is None:
        return "network namespaces need root and `ip` (Debian: iproute2)"
    made = subprocess.run(["unshare", "--net", "true"], capture_output=True)
    return "" if made.returncode == 0 else "this system allows no network namespaces"


@contextmanager
def two_nodes() -> Iterator[list[tuple[str, ...]]]:
    """For each node the words that have a command run there; the first one's address is 10.77.0.1."""
    name = f"ml{os.getpid()}"
    try:
        for number in (1, 2):
            # Both have one name, which each resolves to the address at which the other one reaches it.
            about = Path(f"/etc/netns/{name}-{number}")
            about.mkdir(parents=True)
            own = f"10.77.0.{number} {os.uname().nodename}"
            (about / "hosts").write_text(f"127.0.0.1 localhost\n{own}\n10.77.0.{3 - number} other\n")
            (about / "resolv.conf").write_text("options timeout:1 attempts:1\n")
            _ip("netns", "add", f"{name}-{number}")
        pair = [f"{name[:11]}v{number}" for number in (1, 2)]
        _ip("link", "add", pair[0], "type", "veth", "peer", "name", pair[1])
        for number, link in enumerate(pair, start=1):
            _ip("link", "set", link, "netns", f"{name}-{number}")
            inside = ("-n", f"{name}-{number}")
            _ip(*inside, "address", "add", f"10.77.0.{number}/24", "dev", link)
            for one in (link, "lo"):
                _ip(*inside, "link", "set", one, "up")
        yield [
            ("ip", "netns", "exec", f"{name}-{number}", "env", f"GLOO_SOCKET_IFNAME={pair[number - 1]}")
            for number in (1, 2)
        ]
    finally:
        for number in (1, 2):
            subprocess.run(["ip", "netns", "del", f"{name}-{number}"], capture_output=True)
            shutil.rmtree(f"/etc/netns/{name}-{number}", ignore_errors=True)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)
