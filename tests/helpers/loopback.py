"""Servers on loopback for the tests of remote data: HTTP with byte ranges, S3 (moto), and a bad network."""

from __future__ import annotations

import contextlib
import http.client
import re
import threading
from collections.abc import Callable, Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

Answer = Callable[[BaseHTTPRequestHandler, int], bool]
"""(request, its number from 0) -> whether it has been dealt with."""


class Files(SimpleHTTPRequestHandler):
    """A folder; `ranges` says whether byte ranges are served, `answer` may deal with a request first."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    ranges = True
    answer: Answer | None = None
    seen: list[str]

    def do_GET(self) -> None:
        self.seen.append(f"{self.path} {self.headers.get('Range', '')}".strip())
        if self.answer is not None and self.answer(len(self.seen) - 1):
            return
        asked = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        path = Path(self.translate_path(self.path))
        if not (self.ranges and asked and path.is_file()):
            super().do_GET()
            return
        content = path.read_bytes()
        first, last = int(asked[1]), min(int(asked[2]), len(content) - 1)
        if first > last:
            self.send_error(416)
            return
        self.send_response(206)
        self.send_header("Content-Range", f"bytes {first}-{last}/{len(content)}")
        self.send_header("Content-Length", str(last - first + 1))
        self.end_headers()
        self.wfile.write(content[first : last + 1])

    def log_message(self, *_: object) -> None:
        pass


@contextlib.contextmanager
def serving(handler: Callable[..., BaseHTTPRequestHandler]) -> Iterator[int]:
    """Serve on a free port of loopback."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    try:
        yield server.server_port
    finally:
        server.shutdown()
        server.server_close()


@contextlib.contextmanager
def web(
    folder: Path, *, ranges: bool = True, answer: Answer | None = None
) -> Iterator[tuple[str, list[str]]]:
    """(URL, requests so far) of a web server for `folder`."""
    seen: list[str] = []
    handler = type("Handler", (Files,), {"seen": seen, "ranges": ranges, "answer": answer})
    with serving(partial(handler, directory=str(folder))) as port:
        yield f"http://127.0.0.1:{port}", seen


def fail(request: BaseHTTPRequestHandler, kind: int) -> None:
    """Spoil one answer on the wire: 500, 503, a connection dropped at once or in the middle of the body."""
    if kind in (0, 1):
        request.send_response((500, 503)[kind])
        request.send_header("Content-Length", "0")
        request.end_headers()
        return
    if kind == 3 and request.command != "HEAD":  # whose answer has no body
        request.send_response(200)
        request.send_header("Content-Length", "1000000")
        request.end_headers()
        request.wfile.write(b"x" * 1000)
        request.wfile.flush()
    request.close_connection = True


OWN_HEADERS = {"transfer-encoding", "content-length", "connection", "server", "date"}


class Network:
    """A proxy in front of a server of which one request in `every` fails, in the four ways in turn."""

    def __init__(self, port: int, every: int) -> None:
        self.port, self.every = port, every
        self.requests = self.failures = self.received = 0
        """`received`: bytes of answers."""
        self.puts = 0
        self.in_a_put: tuple[int, Callable[[], None]] | None = None
        """What is called when half the body of a PUT has come, and of which one from 0."""
        self._lock = threading.Lock()

    def spoilt(self) -> int | None:
        """The kind of failure of the next request, if it is to fail."""
        with self._lock:
            self.requests += 1
            if not self.every or self.requests % self.every:
                return None
            self.failures += 1
            return (self.failures - 1) % 4

    def handler(self, *arguments: object) -> BaseHTTPRequestHandler:
        network = self

        class Forward(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            disable_nagle_algorithm = True

            def _forward(self) -> None:
                length = int(self.headers.get("Content-Length") or 0)
                body = self.rfile.read(length // 2)
                if self.command == "PUT":
                    with network._lock:
                        network.puts += 1
                        acts = network.in_a_put is not None and network.in_a_put[0] == network.puts - 1
                    if acts and network.in_a_put is not None:
                        network.in_a_put[1]()
                        return
                body += self.rfile.read(length - len(body))
                kind = network.spoilt()
                if kind is not None:
                    fail(self, kind)
                    return
                inner = http.client.HTTPConnection("127.0.0.1", network.port)
                inner.request(self.command, self.path, body, dict(self.headers))
                answer = inner.getresponse()
                content = answer.read()
                network.received += len(content)
                self.send_response(answer.status)
                for name, value in answer.getheaders():
                    if name.lower() not in OWN_HEADERS:
                        self.send_header(name, value)
                head = self.command == "HEAD"
                length = answer.headers["Content-Length"] if head else str(len(content))
                self.send_header("Content-Length", length)
                self.end_headers()
                self.wfile.write(content)
                inner.close()

            do_GET = do_HEAD = do_PUT = do_POST = do_DELETE = _forward  # noqa: N815

            def log_message(self, *_: object) -> None:
                pass

        return Forward(*arguments)  # type: ignore[arg-type]


@contextlib.contextmanager
def bucket(folder: Path, *, every: int = 0) -> Iterator[tuple[dict[str, str], Network]]:
    """(environment, network): an S3 server whose bucket `shards` holds `folder` under `made/`."""
    import boto3
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    _, port = server.get_host_and_port()
    keys = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1"}
    client = boto3.client(
        "s3", endpoint_url=f"http://127.0.0.1:{port}", region_name="us-east-1",
        aws_access_key_id="test", aws_secret_access_key="test",
    )  # fmt: skip
    client.create_bucket(Bucket="shards")
    for path in sorted(folder.iterdir()):
        client.upload_file(str(path), "shards", f"made/{path.name}")
    network = Network(port, every)
    try:
        with serving(network.handler) as outside:
            yield {**keys, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{outside}"}, network
    finally:
        server.stop()
