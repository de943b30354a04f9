"""Messages between processes of a run: a line of JSON each, over a socket, without ever waiting.

A closed connection says at once that a process has died: the system closes it, however the process ended. For
a machine that has died or cannot be reached the system asks every few seconds (TCP keepalive); it answers for
a process that is merely stopped.
"""

from __future__ import annotations

import contextlib
import json
import socket
from typing import Any

_LONGEST = 1 << 16
"""Bytes that may be waiting in one direction; who sends more does not belong to the run."""
_GONE_AFTER = 20
"""Seconds without an answer of the other machine after which the connection counts as closed."""


class Line:
    """One connection."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._read, self._write = b"", b""
        self.closed = False
        """By the other side, or broken."""
        sock.setblocking(False)
        options = {
            "TCP_KEEPIDLE": 5,
            "TCP_KEEPINTVL": 5,
            "TCP_KEEPCNT": 3,
            "TCP_USER_TIMEOUT": _GONE_AFTER * 1000,
        }
        with contextlib.suppress(OSError):  # not every system has them all
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for name, value in options.items():
                if hasattr(socket, name):
                    sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def fileno(self) -> int:
        """For `select`."""
        return self._sock.fileno()

    def send(self, message: dict[str, Any]) -> None:
        """Send, or keep for later what the other side has no room for; a process that reads nothing at all
        gets no more.
        """
        if len(self._write) < _LONGEST:
            self._write += json.dumps(message).encode() + b"\n"
        try:
            while self._write:
                self._write = self._write[self._sock.send(self._write) :]
        except BlockingIOError:
            pass
        except OSError:
            self.closed = True

    def receive(self) -> list[dict[str, Any]]:
        """The messages that are here."""
        try:
            while block := self._sock.recv(_LONGEST):
                self._read += block
                if len(self._read) > 16 * _LONGEST:
                    break
            else:
                self.closed = True
        except BlockingIOError:
            pass
        except OSError:
            self.closed = True
        *whole, self._read = self._read.split(b"\n")
        if len(self._read) > _LONGEST:
            self.closed = True
        found: list[dict[str, Any]] = []
        for text in whole:
            try:
                message = json.loads(text)
            except ValueError:
                message = None
            if not isinstance(message, dict):  # no process of this run says that
                self.closed = True
                return found
            found.append(message)
        return found

    def close(self) -> None:
        """Close this side."""
        self._sock.close()
