"""Two network namespaces with a cable between them: two machines, as far as a launcher can see.

Each has a host name of its own, knows both by their addresses, and has no name server: what a training looks
up it finds there or not at all.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

ADDRESSES = ("10.77.31.1", "10.77.31.2")
_SETTINGS = Path("/etc/netns")
"""Where `ip netns exec` looks for files to put in the place of those in /etc."""


class Node(NamedTuple):
    """One of the two."""

    name: str
    """Of its namespace, and of the host."""
    device: str
    """Its end of the cable."""
    address: str

    def words(self, *command: object) -> list[str]:
        """The command, run there."""
        named = ["unshare", "--uts", "sh", "-c", f'hostname {self.name} && exec "$@"', "sh"]
        return ["ip", "netns", "exec", self.name, *named, *map(str, command)]


def why_not() -> str:
    """Why there can be no namespaces here; empty when there can."""
    if os.name != "posix" or os.geteuid() != 0:
        return "making network namespaces needs root"
    for program, package in (("ip", "iproute2"), ("unshare", "util-linux"), ("hostname", "hostname")):
        if shutil.which(program) is None:
            return f"not installed: {program} (Debian: {package})"
    trial = f"trial-{os.getpid()}"
    if subprocess.run(["ip", "netns", "add", trial], capture_output=True).returncode:
        return "this machine lets nobody make network namespaces"
    subprocess.run(["ip", "netns", "delete", trial], check=True)
    return ""


@contextmanager
def two_networks() -> Iterator[tuple[Node, Node]]:
    """Both nodes, and nothing of them afterwards."""
    mark = f"m{os.getpid() % 10**6}"
    first, second = (
        Node(f"{mark}{side}", f"{mark}{side}", address) for side, address in zip("ab", ADDRESSES, strict=True)
    )
    with ExitStack() as left:
        for node in (first, second):
            _ip("netns", "add", node.name)
            left.callback(_ip, "netns", "delete", node.name)
            folder = _SETTINGS / node.name
            folder.mkdir(parents=True)
            left.callback(shutil.rmtree, folder)
            names = [f"{one.address} {one.name}" for one in (first, second)]
            (folder / "hosts").write_text("\n".join(["127.0.0.1 localhost", *names, ""]))
            (folder / "resolv.conf").write_text("options timeout:1 attempts:1\n")
        _ip("link", "add", first.device, "netns", first.name, "type", "veth",
            "peer", "name", second.device, "netns", second.name)  # fmt: skip
        for node in (first, second):
            for words in (
                ("address", "add", f"{node.address}/24", "dev", node.device),
                ("link", "set", node.device, "up"),
                ("link", "set", "lo", "up"),
            ):
                _ip("-netns", node.name, *words)
        yield first, second


def _ip(*words: str) -> None:
    done = subprocess.run(["ip", *words], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"ip {' '.join(words)}: {done.stderr.strip()}")
