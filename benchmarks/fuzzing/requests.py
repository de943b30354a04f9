"""Requests to the server, as its application gets them; the model is a quick one of the tests."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import logging
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from fuzzing import files
from fuzzing.mutations import Mutator, damaged_json, damaged_text
from fuzzing.sealed import damaged_glb, damaged_zip
from fuzzing.sounds import damaged_flac, damaged_mp3, damaged_ogg, damaged_wav
from fuzzing.table import ROOT, Read, Seed, reader
from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.serve.app import Site
from motionloom.pipeline.serve.requests import ServeConfig

GENERATE = (
    {
        "caption": "a person walks",
        "seconds": 1.0,
        "seed": 3,
        "format": "joints",
        "cfg_scale": 2,
        "top_p": 0.9,
    },
    {"caption": "waves", "face": "happy", "temperature": 0.5, "format": "bvh"},
)
EDIT = (
    {
        "clip": "",
        "task": {
            "keep": [{"start": 0, "end": 0.5, "parts": ["all"], "but": ["left_hand"]}],
            "caption": "waves",
            "seconds": 2,
            "lead": 0.2,
        },
        "seed": 1,
        "format": "joints",
    },
    {
        "clip": "",
        "task": {
            "path": [{"at": 0.2, "x": 0, "z": 0}, {"at": 1.2, "x": 0.5, "z": 1}],
            "pins": [{"at": 1, "joint": "left_wrist", "position": [0.3, 1.2, 0.2]}],
        },
        "format": "viewer",
    },
    {"clip": "", "task": {"mirror": True, "speed": 1.5, "repeat": 2}, "format": "npz"},
)


def _quick_site() -> Site:
    spec = importlib.util.spec_from_file_location("quick_server", ROOT / "tests/pipeline/serve/conftest.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return Site(module.QuickModel(lambda frames: files.walked(frames)), ServeConfig(max_seconds=5.0), "quick")


def _ask(site: Site, path: str, body: bytes, media: str) -> tuple[int, bytes]:
    """Status and body of the answer to one POST."""
    answered: dict[str, Any] = {"status": 0, "body": b""}
    sent = [{"type": "http.request", "body": body, "more_body": False}]

    async def receive() -> dict[str, object]:
        return sent.pop() if sent else {"type": "http.disconnect"}

    async def send(message: dict[str, Any]) -> None:
        answered["status"] = message.get("status", answered["status"])
        answered["body"] += message.get("body", b"")

    headers = [(b"host", b"localhost"), (b"content-type", media.encode())]
    scope = {
        "type": "http",
        "method": "POST",
        "path": path,
        "raw_path": path.encode(),
        "query_string": b"",
        "headers": headers,
        "scheme": "http",
        "http_version": "1.1",
        "server": ("localhost", 80),
        "client": ("127.0.0.1", 1),
        "root_path": "",
        "asgi": {"version": "3.0"},
    }
    asyncio.run(site.app(scope, receive, send))  # type: ignore[arg-type]
    return int(answered["status"]), bytes(answered["body"])


def routes() -> list[str]:
    """The requests with a body that the server answers."""
    inside: Any = _quick_site().app
    return [route.path for route in inside.routes if "POST" in (route.methods or ())]


def _request(path: str, media: str, contents: Callable[[Path], list[tuple[str, bytes, Mutator]]]) -> None:
    def make(folder: Path) -> tuple[list[Seed], Read]:
        logging.disable(logging.CRITICAL)
        sent = files.bvh_clip(folder, 40)

        @cache
        def served(process: int) -> tuple[Site, str]:
            """A site, whose thread a fork does not have, and the name of a clip that it keeps."""
            site = _quick_site()
            return site, json.loads(_ask(site, "/api/clips", sent, "")[1])["clip"]

        def read(seed: Seed, content: bytes) -> object:
            site, clip = served(os.getpid())
            content = content.replace(b'"clip": ""', b'"clip": "%s"' % clip.encode())
            status, body = _ask(site, path, content, media)
            if status in (400, 413):
                said = json.loads(body)["error"]
                if not isinstance(said, str) or not said:
                    raise AssertionError("a refusal without a sentence")
                raise UserError(said)
            if status != 200:
                raise AssertionError(f"status {status}")
            return body

        return [Seed(path.strip("/"), content, damage) for _, content, damage in contents(folder)], read

    reader(f"POST {path}", "serve/app.py")(make)


def _as_json(bodies: tuple[dict[str, Any], ...]) -> list[tuple[str, bytes, Mutator]]:
    return [("", json.dumps(body).encode(), damaged_json) for body in bodies]


def _sounds(folder: Path) -> list[tuple[str, bytes, Mutator]]:
    kinds: tuple[tuple[str, Mutator], ...] = (
        ("wav", damaged_wav),
        ("flac", damaged_flac),
        ("ogg", damaged_ogg),
        ("mp3", damaged_mp3),
    )
    return [("", files.sound(folder, ending), damage) for ending, damage in kinds]


def _clips(folder: Path) -> list[tuple[str, bytes, Mutator]]:
    return [
        ("", files.bvh_clip(folder), damaged_text),
        ("", files.npz_clip(folder), damaged_zip),
        ("", files.glb_clip(folder), damaged_glb),
    ]


ROUTES = ("/api/generate", "/api/edit", "/api/sounds", "/api/clips")
_request("/api/generate", "application/json", lambda folder: _as_json(GENERATE))
_request("/api/edit", "application/json", lambda folder: _as_json(EDIT))
_request("/api/sounds", "audio/any", _sounds)
_request("/api/clips", "", _clips)
