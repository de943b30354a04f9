"""The page of `motionloom search`: words, neighbours, dropped clips, and what is refused."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from motionloom.datasets.check.suspects import Place, open_splits
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.evaluation.search import Codes, Search
from motionloom.pipeline.serve.search import SHOWN, SearchSite

CLIPS = 14


@pytest.fixture(scope="module")
def search(tmp_path_factory: pytest.TempPathFactory) -> Search:
    """Clip k of the set is the k-th unit vector, which the word "k" means; a dropped clip is the first."""
    root = tmp_path_factory.mktemp("data")
    config = SynthConfig(clips=CLIPS, layout="body133", val_fraction=0.0, test_fraction=0.0, max_seconds=5)
    synthesize(config, root)
    tma = SimpleNamespace(
        embed_captions=lambda texts, source: torch.eye(CLIPS)[[int(text) for text in texts]],
        given={"text": None},
    )
    places = tuple(Place("train", k) for k in range(CLIPS))
    found = Search(open_splits(root), tma, Codes.of(np.eye(CLIPS, dtype=np.float32)), places)  # type: ignore[arg-type]
    object.__setattr__(found, "motion", lambda joints, fps: np.eye(CLIPS, dtype=np.float32)[0])
    return found


@pytest.fixture
def served(run_site: Callable[..., Any], search: Search) -> Iterator[Any]:
    with run_site(lambda config, worker: SearchSite(search, config, "mine"), max_caption=5) as made:
        yield made


def test_answers(served: Any, search: Search) -> None:
    assert served.ask("GET", "/api/info").json == {"name": "mine", "clips": CLIPS}
    by_words = served.post("/api/search", {"words": "3"}).json
    assert by_words["found"][0] == search.ids[3] and len(by_words["found"]) == SHOWN
    first = by_words["viewer"]["motions"][0]
    assert first["label"].startswith("1.00 · train · ") and first["frames"] > 20
    alike = served.post("/api/search", {"like": search.ids[3]}).json
    assert search.ids[3] not in alike["found"]
    clip = io.BytesIO()
    np.save(clip, search.splits["train"].motion(5))
    assert served.ask("POST", "/api/like", clip.getvalue()).json["found"][0] == search.ids[0]


@pytest.mark.parametrize(
    ("path", "body", "said"),
    [
        ("/api/search", b"{", "not JSON"),
        ("/api/search", b'{"word": "3"}', "unknown key 'word'"),
        ("/api/search", b'{"words": " "}', "no words"),
        ("/api/search", b'{"words": "123456"}', "at most 5 letters"),
        ("/api/search", b'{"like": "nobody"}', "no clip 'nobody'"),
        ("/api/like", b"PK?", "the clip: not an .npz file"),
    ],
)
def test_refused(path: str, body: bytes, said: str, served: Any) -> None:
    answer = served.ask("POST", path, body)
    assert answer.status == 400 and said in answer.json["error"]
    assert served.ask("POST", path, body, {"Origin": "http://elsewhere.example"}).status == 403


@pytest.mark.browser
def test_type_watch_and_look_for_more(
    browser: Any, until: Any, served: Any, search: Search, tmp_path: Path
) -> None:
    trouble: list[str] = []
    page = browser.new_page(viewport={"width": 1200, "height": 800})
    page.on("pageerror", lambda error: trouble.append(str(error)))
    page.on("console", lambda m: trouble.append(m.text) if "Content Security" in m.text else None)
    page.goto(f"http://127.0.0.1:{served.port}/")
    until(page, f"document.getElementById('status').textContent === 'mine: {CLIPS} clips'")
    page.locator("#words").fill("4")
    page.get_by_role("button", name="Search").click()
    until(page, "window.__viewer && window.__viewer.draws > 2")
    assert page.locator(".mlv-label").first.text_content() == f"1.00 · train · {search.ids[4]}"
    page.get_by_role("button", name="More like this").first.click()
    until(page, f"document.getElementById('status').textContent.startsWith('Nearest to {search.ids[4]}')")
    assert page.locator(".mlv-cell").count() == SHOWN and page.evaluate("__viewers.length") == 1
    page.locator("#words").fill("  ")
    page.get_by_role("button", name="Search").click()
    until(page, "document.getElementById('status').classList.contains('serve-wrong')")
    page.close()
    assert not trouble, json.dumps(trouble)
