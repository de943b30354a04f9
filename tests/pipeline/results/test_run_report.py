"""A run that was trained, whole and with stages taken away: its report."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from html import unescape
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def unfinished(small_run: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run as a kill in the middle of the GPT's training leaves it."""
    folder = tmp_path_factory.mktemp("unfinished") / "run"
    shutil.copytree(small_run.folder, folder)
    for name in ("face_gpt", "face_vae", "face_diffusion", "generate", "evaluate", "report"):
        shutil.rmtree(folder / "stages" / name)
    gpt = folder / "stages/gpt"
    for name in ("artifact.json", "timing.json", "model.safetensors", "model.json"):
        (gpt / name).unlink()
    rows = (gpt / "metrics.jsonl").read_text().splitlines(keepends=True)
    (gpt / "metrics.jsonl").write_text("".join(row for row in rows if json.loads(row)["step"] <= 12))
    return folder


def text_of(page: Path) -> str:
    html = page.read_text(encoding="utf-8")
    return unescape(re.sub(r"<[^>]+>", " ", re.sub(r"<(script|style).*?</\1>", "", html, flags=re.S)))


def test_the_report_of_a_finished_run(small_run: Any) -> None:
    text = text_of(small_run.folder / "stages/report/report.html")
    for words in ("Figures on held-out clips", "Settings of every", "52 joints at 20 "):
        assert words in text, words
    assert "in training" not in text and "Still missing" not in text


def test_the_report_of_an_unfinished_run(unfinished: Path, tmp_path: Path, call: Callable[..., Any]) -> None:
    done = call("report", unfinished)
    assert done.code == 0, done.err
    assert re.search(r"gpt \(.*12 of 30\), face_gpt", done.out)
    text = text_of(unfinished / "report/report.html")
    assert "step 12 of 30" in text and "evaluate: not run yet" in text
    assert "the recorded clip, and" in text
    assert "that the model made" not in text and "Figures on held-out clips" not in text
    assert "gpt: cross-entropy" in text and "tokenizer: reconstruction" in text, "its curves so far"
    assert "9 of 15" not in text and "8 of 15" in text
    bare = tmp_path / "bare"  # a run that has hardly begun
    bare.mkdir()
    shutil.copy(unfinished / "recipe.yaml", bare)
    done = call("report", bare)
    assert done.code == 0, done.err
    text = text_of(bare / "report/report.html")
    assert "data: not run yet" in text and "0 of 15" in text and "Settings of every stage" in text
