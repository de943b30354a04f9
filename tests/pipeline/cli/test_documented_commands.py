"""The commands of docs/data.md and docs/sources.md as typed, in a folder that has such sources."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from bvh_clips import write_source

ROOT = Path(__file__).resolve().parents[3]


def typed(page: str) -> list[list[str]]:
    """The words of each `motionloom` command in the page's `sh` blocks."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    blocks = "".join(re.findall(r"^```sh\n(.*?)^```$", text, re.M | re.S))
    lines = re.sub(r"\\\n\s*", "", blocks).splitlines()
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("motionloom ")]


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("page", ["data.md", "sources.md"])
def test_commands_of_a_page_run_as_typed(
    page: str, shared: Path, call: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("decisions.json").write_text('{"left_out": {"synth-0-000003": "floats"}}')
    Path("Motion-X").symlink_to(shared / "data" / "layouts" / "motionx")
    for folder in ("mocap", "cmu", "cmu-texts"):
        Path(folder).mkdir()
    for folder in ("mocap", "cmu"):
        names = [f"{subject:02}_{take:02}" for subject in range(1, 9) for take in (1, 2)]
        write_source(Path(folder), names)
        (Path(folder) / "map.json").unlink()
    lines = [f'{{"id": "{name}", "captions": ["a person walks"]}}\n' for name in names]
    Path("mocap/captions.jsonl").write_text("".join(lines))
    Path("captions.jsonl").write_text('{"id": "synth-0-000003", "captions": ["somebody moves"]}\n')
    for name in names:
        Path(f"cmu-texts/{name}.txt").write_text("a person walks\n")
    before: list[str] = []
    for words in typed(page):
        if any("s3://my-bucket" in word for word in words):
            continue  # tried with a bucket by test_staging.py and test_store.py
        if words[:2] == ["data", "join"]:  # all parts before, of which the page types one
            for part in range(1, 9):
                assert call(*before[:-1], f"{part}/8").code == 0
        done = call(*words)
        before = words
        assert done.code == 0, f"{shlex.join(words)}: {done.out[-500:]} {done.err[-2000:]}"
