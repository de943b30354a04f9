"""librosa is compiled by one process at a time, and again wherever numba's cache is not filled."""

from __future__ import annotations

import importlib.util
import os
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from motionloom.datasets.audio import compiled


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    compiled.load_librosa.cache_clear()
    yield tmp_path / "cache"
    compiled.load_librosa.cache_clear()


def test_who_finds_the_mark_does_not_wait(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first of two that start together compiles, the second waits for it; a third just imports."""
    inside, most, calls, guard = 0, 0, 0, threading.Lock()
    started = threading.Barrier(2)

    def imported() -> str:
        nonlocal inside, most, calls
        with guard:
            inside, calls = inside + 1, calls + 1
            most = max(most, inside)
        threading.Event().wait(0.2)
        with guard:
            inside -= 1
        return "librosa"

    def load() -> None:
        started.wait()
        compiled.load_librosa.__wrapped__()

    monkeypatch.setattr(compiled, "_imported", imported)
    threads = [threading.Thread(target=load) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (most, calls) == (1, 2)
    assert len(list(cache.glob("motionloom-*.compiled"))) == 1
    for lock in cache.glob("*.lock"):
        lock.unlink()
    assert compiled.load_librosa() == "librosa"
    assert not list(cache.glob("*.lock")), "the mark was enough"


def test_a_mark_holds_for_one_cache_and_one_processor(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = compiled._mark()
    assert here.parent == cache
    monkeypatch.setattr(compiled, "_processor", lambda: "another")
    assert compiled._mark().name != here.name
    monkeypatch.undo()
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    spec = importlib.util.find_spec("librosa")
    assert spec is not None and spec.origin is not None
    beside = Path(spec.origin).parent / "__pycache__"
    own = Path(tempfile.gettempdir()) / f"motionloom-{os.getuid()}"
    assert compiled._mark().parent in (beside, own), (
        "cleared together with numba's files, where they lie there"
    )


def test_a_cache_folder_that_cannot_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "cache"))
    assert compiled._mark().parent == Path(tempfile.gettempdir()) / f"motionloom-{os.getuid()}"
