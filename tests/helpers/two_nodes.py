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
    """For each node the words that have a command run there; their addresses are 10.77.0.1 and 10.77.0.2."""
    names = [f"ml{os.getpid()}-{number}" for number in (1, 2)]
    places = [Path("/etc/netns", name) for name in names]
    try:
        for number, (name, place) in enumerate(zip(names, places, strict=True), start=1):
            # Both have one name, which each resolves to the address at which the other one reaches it.
            place.mkdir(parents=True)
            (place / "hosts").write_text(f"127.0.0.1 localhost\n10.77.0.{number} {os.uname().nodename}\n")
            (place / "resolv.conf").write_text("options timeout:1 attempts:1\n")
            _ip(f"netns add {name}")
        _ip(f"link add veth netns {names[0]} type veth peer name veth netns {names[1]}")
        for number, name in enumerate(names, start=1):
            _ip(f"-n {name} address add 10.77.0.{number}/24 dev veth")
            _ip(f"-n {name} link set veth up")
            _ip(f"-n {name} link set lo up")
        yield [("ip", "netns", "exec", name, "env", "GLOO_SOCKET_IFNAME=veth") for name in names]
    finally:
        for name, place in zip(names, places, strict=True):
            subprocess.run(["ip", "netns", "del", name], capture_output=True)
            shutil.rmtree(place, ignore_errors=True)


def _ip(words: str) -> None:
    subprocess.run(["ip", *words.split()], check=True, capture_output=True)
