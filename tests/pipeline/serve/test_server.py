"""`motionloom serve` over HTTP: answers, refusals, who may ask, many at once, and its end."""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from rich.console import Console
from rig_characters import character

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.serve import guard, server
from motionloom.pipeline.serve.requests import ServeConfig
from motionloom.pipeline.serve.server import listen

WAVE = {"caption": "a person waves", "seconds": 1.0}


@pytest.fixture
def served(run_server: Callable[..., Any], quick: Any) -> Iterator[Any]:
    with run_server(quick, max_seconds=5.0, max_sound_mb=1.0, sounds=1) as made:
        yield made


def tone(seconds: float, loud: float = 0.5, kind: str = "WAV") -> bytes:
    out = io.BytesIO()
    wave = loud * np.sin(2 * np.pi * 220 * np.arange(round(seconds * 16_000)) / 16_000)
    soundfile.write(out, wave.astype(np.float32), 16_000, format=kind)
    return out.getvalue()


def test_a_motion_as_numbers(served: Any) -> None:
    got = served.post("/api/generate", {**WAVE, "seed": 7})
    said = got.json
    assert got.status == 200
    assert (said["caption"], said["seed"], said["frames"], said["fps"]) == ("a person waves", 7, 20, 20.0)
    joints = np.array(said["joints"])
    assert joints.shape == (20, len(said["joint_names"]), 3) and joints[0, 0, 0] == pytest.approx(0.007)
    assert said["parents"][0] == -1 and len(said["parents"]) == len(said["joint_names"])


def test_the_viewers_data_and_files(served: Any, tmp_path: Path) -> None:
    data = served.post("/api/generate", {**WAVE, "format": "viewer"}).json["viewer"]
    assert data["motions"][0]["frames"] == 20 and data["motions"][0]["caption"] == "a person waves"
    bvh = served.post("/api/generate", {**WAVE, "format": "bvh"})
    assert bvh.body.startswith(b"HIERARCHY")
    assert bvh.headers["content-disposition"] == "attachment; filename*=UTF-8''00-a-person-waves.bvh"
    path = tmp_path / "made.npz"
    path.write_bytes(served.post("/api/generate", {**WAVE, "format": "npz", "seed": 3}).body)
    with np.load(path, allow_pickle=False) as file:
        assert file["joints"].shape == (20, 52, 3) and json.loads(str(file["metadata"]))["seed"] == 3
    page = served.post("/api/generate", {**WAVE, "format": "html"}).body.decode()
    assert page.startswith("<!doctype html>") and "a person waves" in page


def test_motions_on_ones_own_character(run_server: Callable[..., Any], quick: Any, tmp_path: Path) -> None:
    character(tmp_path / "hero.vrm", "vrm1")
    with run_server(quick, rig=tmp_path / "hero.vrm") as served:
        assert served.ask("GET", "/api/info").json["character"] == {"possible": True}
        made = served.post("/api/generate", {**WAVE, "format": "rig"}).body
        assert made.startswith(b"glTF") and b'"VRMC_vrm"' in made and b'"animations"' in made
        page = served.post("/api/generate", {**WAVE, "format": "rig-page"}).body
        assert b"<" not in page.partition(b'id="data">')[2].partition(b"</script>")[0]


def test_a_model_that_must_be_told_a_length_is_told_one(served: Any, quick: Any) -> None:
    quick.bundle.generator.decides_length = False
    assert served.post("/api/generate", {"caption": "a person waves"}).json["seconds"] == 4.0


def test_info_and_page(served: Any) -> None:
    info = served.ask("GET", "/api/info").json
    assert info["model"] == "quick" and info["modalities"] == ["audio", "text"] and info["face"] is True
    assert info["sampling"] == {"cfg_scale": 1.25, "top_p": 0.9}
    assert info["credits"] == ["Motion of nobody."]
    assert info["limits"]["seconds"] == 5.0
    assert info["edit"] == {"possible": True, "why": "", "max_speed": 12.0}
    page = served.ask("GET", "/")
    assert page.status == 200 and page.headers["content-type"].startswith("text/html")
    for name in ("serve.css", "viewer.js", "serve.js", "edit.js", "lanes.js", "figure.js", "task.js"):
        assert served.ask("GET", f"/assets/{name}").status == 200
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'" in policy and "unsafe-inline" not in policy
    assert "<script>" not in page.body.decode() and "style=" not in page.body.decode()


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"captoin": "x"}, "'captoin'"),
        ({"caption": "  "}, "caption"),
        ({**WAVE, "seconds": 5.1}, "5.1 s"),
        ({**WAVE, "seconds": 3601}, "seconds"),
        ({**WAVE, "seed": -1}, "seed"),
        ({**WAVE, "cfg_scale": 21}, "cfg_scale"),
        ({"caption": "w" * 301}, "301"),
        ({**WAVE, "format": "exe"}, "format"),
        ({**WAVE, "sound": "../../etc/passwd"}, "sound"),
        (["a person waves"], "JSON"),
    ],
)
def test_bad_input_is_one_sentence(served: Any, quick: Any, body: Any, words: str) -> None:
    got = served.post("/api/generate", body)
    assert got.status == 400 and words in got.json["error"] and "\n" not in got.json["error"]
    assert not quick.asked


def test_words_that_the_model_does_not_know_are_noted(served: Any) -> None:
    asked = {**WAVE, "caption": "a person plays the violin", "face": "a face like a violin"}
    for kind in ("joints", "viewer"):
        notes = served.post("/api/generate", {**asked, "format": kind}).json["notes"]
        assert [note.partition(" is unlike")[0] for note in notes] == [
            f"'{asked[k]}'" for k in ("caption", "face")
        ]
    assert served.post("/api/generate", WAVE).json["notes"] == []
    page = served.post("/api/generate", {**asked, "format": "html"}).body.decode()
    assert page.count("a person plays the violin") and page.count("a face like a violin")


def test_what_is_no_request(served: Any) -> None:
    for body, words in ((b"{", "JSON"), (b"[" * 10_000, "JSON"), (b'{"face": "\\udfff"}', "surrogate")):
        got = served.ask("POST", "/api/generate", body, {"Content-Type": "application/json"})
        assert got.status == 400 and words in got.json["error"]
    assert served.ask("POST", "/api/generate", b"caption=x", {"Content-Type": "text/plain"}).status == 415
    assert served.ask("GET", "/api/generate").status == 405
    assert served.ask("GET", "/assets/../../pyproject.toml").status == 404
    assert served.ask("GET", "/assets/%2e%2e%2fapp.py").status == 404
    large = served.post("/api/generate", {"caption": "x" * 20_000})
    assert large.status == 413 and "16384" in large.json["error"]


def test_a_slow_request_is_let_go(run_server: Callable[..., Any], quick: Any) -> None:
    """And sixty that send a sound slowly keep nobody else's waiting until they are."""
    head = b"POST /api/sounds HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\n{"
    with run_server(quick, patience=5.0) as served, contextlib.ExitStack() as held:
        slow = [held.enter_context(socket.create_connection(("127.0.0.1", served.port))) for _ in range(60)]
        for raw in slow:
            raw.sendall(head)
        assert served.ask("POST", "/api/sounds", tone(1.0)).status == 200
        slow[0].setblocking(False)
        with pytest.raises(BlockingIOError):
            slow[0].recv(64)
        slow[0].settimeout(20)
        assert slow[0].recv(64).startswith(b"HTTP/1.1 408")


def test_half_sent_headers_are_let_go(run_server: Callable[..., Any], quick: Any) -> None:
    with run_server(quick, patience=1.0, connections=3) as served, contextlib.ExitStack() as held:
        slow = [held.enter_context(socket.create_connection(("127.0.0.1", served.port))) for _ in range(3)]
        slow[2].sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert slow[2].recv(1 << 20).startswith(b"HTTP/1.1 200")
        for raw in slow[1:]:
            raw.sendall(b"GET / HTTP/1.1\r\nHo")
        served.wait_for(lambda: len(served.server.server_state.connections) == 3)
        assert served.ask("GET", "/api/info").status == 503
        with contextlib.suppress(OSError):
            while served.server.server_state.connections:
                slow[1].sendall(b"s")
                time.sleep(0.05)
        served.wait_for(lambda: not served.server.server_state.connections)
        assert served.ask("GET", "/api/info").status == 200


def test_uploads_over_the_limit_get_their_sentence(served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the client closes behind its request."""
    for path, header in itertools.product(("/api/sounds", "/api/clips"), ({}, {"Connection": "close"})):
        got = served.ask("POST", path, bytes(40 << 20), header)
        assert got.status == 413 and "larger than this server takes" in got.json["error"]
    monkeypatch.setattr(served.site._bodies, "most", 1000)
    got = served.ask("POST", "/api/sounds", bytes(1 << 20))
    assert got.status == 503 and "too much is being uploaded" in got.json["error"]


def test_connections_are_bounded(run_server: Callable[..., Any], quick: Any) -> None:
    with run_server(quick, connections=2) as served, contextlib.ExitStack() as held:
        for _ in range(2):
            held.enter_context(socket.create_connection(("127.0.0.1", served.port)))
        served.wait_for(lambda: len(served.server.server_state.connections) == 2)
        assert served.ask("GET", "/api/info").status == 503
        held.close()
        served.wait_for(lambda: not served.server.server_state.connections)
        assert served.ask("GET", "/api/info").status == 200


def test_a_bug_is_a_sentence_and_the_server_goes_on(served: Any, capsys: Any) -> None:
    got = served.post("/api/generate", {"caption": "break"})
    assert got.status == 500 and list(got.json) == ["error"]
    assert "default-src 'none'" in got.headers["content-security-policy"]
    assert served.post("/api/generate", WAVE).status == 200


HOSTS: list[tuple[dict[str, str], int, int]] = [
    ({"Host": "evil.example"}, 400, 400),
    ({"Host": "evil.example:8000"}, 400, 400),
    ({"Host": "localhost.evil.example"}, 400, 400),
    ({"Host": "localhost#.evil.example"}, 400, 400),
    ({"Host": "192.168.1.5"}, 400, 400),
    ({"Host": "[::1"}, 400, 400),
    ({"Origin": "http://evil.example"}, 403, 403),
    ({"Origin": "null"}, 403, 403),
    ({"Sec-Fetch-Site": "cross-site"}, 403, 403),
    ({"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}, 200, 403),  # a link may be followed
    ({"Host": "localhost", "Origin": "http://localhost", "Sec-Fetch-Site": "same-origin"}, 200, 200),
    ({"Host": "[::1]:80"}, 200, 200),
]
"""Headers of a browser, and the answers to GET of the page and POST."""


def test_other_sites_are_refused(served: Any, quick: Any) -> None:
    for seed, (headers, page, post) in enumerate(HOSTS):
        before = len(quick.asked)
        seen = served.ask("GET", "/", headers=headers)
        made = served.post("/api/generate", {**WAVE, "seed": seed}, **headers)
        assert (seen.status, made.status) == (page, post), headers
        for got in (seen, made):
            assert "default-src" in got.headers["content-security-policy"]
        assert len(quick.asked) - before == (post == 200)


def test_names_that_are_allowed(run_server: Callable[..., Any], quick: Any) -> None:
    with run_server(quick, host="0.0.0.0", allow_hosts=("Studio.lan", "192.168.1.5")) as served:
        for host, status in (("studio.lan", 200), ("192.168.1.5:80", 200), ("10.0.0.1", 400)):
            assert served.ask("GET", "/api/info", headers={"Host": host}).status == status
    with pytest.raises(UserError, match="allow_hosts"):
        guard.allowed_hosts(ServeConfig(allow_hosts=("*.lan",)))


def test_music_is_sent_and_driven_by(served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "motionloom.pipeline.inference.files.outputs.beats", lambda samples, rate: np.array([0.5])
    )
    name = served.ask("POST", "/api/sounds", tone(3.0)).json
    assert name["seconds"] == 3.0
    assert served.ask("POST", "/api/sounds", tone(3.0)).json == name
    said = served.post("/api/generate", {"sound": name["sound"], "format": "viewer"}).json
    assert said["frames"] == 60 and said["viewer"]["sounds"][0]["mime"] == "audio/mpeg"
    assert said["viewer"]["scores"][0]["beats"] == [0.5] and "beat" in said["heard"]
    given = served.post("/api/generate", {"sound": name["sound"], "format": "viewer", "beats": "120@0.2"})
    assert given.json["heard"].startswith("120 beats a minute") and given.json["clip"] != said["clip"]
    assert served.post("/api/generate", {"sound": name["sound"], "beats": "/etc/passwd"}).status == 400
    said = served.post("/api/generate", {**WAVE, "sound": name["sound"]}).json
    assert said["frames"] == 20 and said["caption"] == "a person waves"
    long = served.ask("POST", "/api/sounds", tone(8.0, kind="OGG")).json["sound"]
    assert served.post("/api/generate", {"sound": long}).json["frames"] == 100  # the server's longest
    assert served.post("/api/generate", {"sound": name["sound"]}).status == 400, "the oldest makes room"


def test_a_sound_that_is_no_music_is_noted(served: Any) -> None:
    name = served.ask("POST", "/api/sounds", tone(3.0, loud=0.0)).json["sound"]
    (note,) = served.post("/api/generate", {"sound": name, "format": "viewer"}).json["notes"]
    assert "figure" in note
    notes = served.post("/api/generate", {**WAVE, "sound": name}).json["notes"]
    assert len(notes) == 1 and notes[0] != note


@pytest.mark.parametrize(
    ("data", "status", "words"),
    [
        (b"", 400, "empty"),
        (b"no sound at all", 400, "the sound: "),
        (tone(1.0)[:9000], 400, "the sound: "),
        (tone(40.0), 413, "1048576"),
    ],
)
def test_what_is_no_music(served: Any, data: bytes, status: int, words: str) -> None:
    got = served.ask("POST", "/api/sounds", data)
    assert got.status == status and words in got.json["error"] and "/tmp" not in got.json["error"]


def test_more_than_may_wait_are_refused(run_server: Callable[..., Any], quick: Any) -> None:
    """Of 200 at once one runs and eight wait; the others hear so at once, and none is without an answer."""
    quick.open.clear()

    def ask(number: int) -> tuple[int, int, Any]:
        got = served.post("/api/generate", {**WAVE, "seed": number})
        return number, got.status, got

    with run_server(quick, waiting=8) as served, ThreadPoolExecutor(200) as clients:
        answers = [clients.submit(ask, number) for number in range(200)]
        served.wait_for(lambda: sum(answer.done() for answer in answers) >= 191)
        quick.open.set()
        results = [answer.result() for answer in answers]
    made = [(number, got) for number, status, got in results if status == 200]
    refused = [(number, got) for number, status, got in results if status == 429]
    assert len(made) == 9 and len(refused) == 191
    assert all(got.json["joints"][0][0][0] == pytest.approx(number / 1000) for number, got in made)
    assert all(got.headers["retry-after"] for _, got in refused)
    assert "8" in refused[0][1].json["error"]


def test_the_end_answers_what_has_begun(run_server: Callable[..., Any], quick: Any) -> None:
    quick.open.clear()
    with run_server(quick) as served, ThreadPoolExecutor(1) as clients:
        runs = clients.submit(served.post, "/api/generate", WAVE)
        served.wait_for(lambda: bool(quick.asked))
        served.server.handle_exit(signal.SIGINT, None)
        quick.open.set()
        assert runs.result().status == 200
        served.thread.join(20)


def test_a_taken_port_is_one_sentence() -> None:
    with (
        listen(ServeConfig(port=0)) as first,
        pytest.raises(UserError, match=r"127.0.0.1 port \d+: .*--port"),
    ):
        listen(ServeConfig(port=first.getsockname()[1]))


def test_without_the_extra_it_says_so(
    monkeypatch: pytest.MonkeyPatch, call: Callable[..., Any], tmp_path: Path
) -> None:
    monkeypatch.delitem(sys.modules, "motionloom.pipeline.serve.server")
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    done = call("serve", tmp_path)
    assert done.code == 2 and "motionloom[serve]" in done.err


def test_wrong_options_are_one_sentence(call: Callable[..., Any], tmp_path: Path) -> None:
    assert "'waiting' = 0" in call("serve", tmp_path, "--set", "waiting=0").err
    assert "missing" in call("serve", tmp_path / "missing").err


@pytest.mark.parametrize(("host", "warned"), [("127.0.0.1", False), ("0.0.0.0", True)])
def test_the_command_says_where_and_who_can_reach_it(
    host: str, warned: bool, quick: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Interrupted:
        def run(self, places: list[socket.socket]) -> None:
            assert places[0].getsockname()[0] == host
            raise KeyboardInterrupt

    monkeypatch.setattr(server.MotionModel, "from_pretrained", lambda *_, **options: quick)
    monkeypatch.setattr(server, "server_of", lambda site: Interrupted())
    said = Console(file=io.StringIO(), width=200)
    server.serve(tmp_path, ServeConfig(host=host, port=0), console=said)
    text = said.file.getvalue()  # type: ignore[attr-defined]
    assert f": http://{host}:" in text and text.endswith("stopped\n")
    assert ("allow_hosts" in text) == warned
