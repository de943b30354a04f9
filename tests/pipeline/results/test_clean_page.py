"""`data clean` as a command and as a page: suspects listed and shown, decisions saved, applied and undone."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Caption
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import write_dataset
from motionloom.datasets.synth.generate import SynthConfig, make_clip
from motionloom.pipeline.results.clean_page import suspects_of

LAYOUT = MotionLayout.named("body133")
CONFIG = SynthConfig(clips=6, seed=3, layout="body133", max_seconds=5)
NASTY = "</script><img src=x onerror=hacked=1>"


def convert(index: int) -> Sample:
    """Clip 4 is clip 3 again; clip 5 leaps."""
    joints = make_clip(min(index, 3) if index < 5 else 5, CONFIG).joints
    if index == 5:
        joints[20:, :, 0] += 0.4
    motion = encode(joints, LAYOUT)
    meta = LAYOUT.clip_meta(f"c{index}", source="s", split="train", frames=len(motion), licence="CC0")
    return Sample(meta, motion, texts=[Caption(text=f"{index} {NASTY}")])


@pytest.fixture
def root(tmp_path: Path) -> Path:
    facts = DatasetFacts("made", LAYOUT, licence="CC0", converter="t", converter_version=1, options={})
    how = WriteOptions(progress=False)
    write_dataset(tmp_path / "set", [("train", k) for k in range(6)], convert, facts, how)
    return tmp_path / "set"


def test_command(root: Path, call: Callable[..., Any], tmp_path: Path) -> None:
    assert call("data", "clean", root).code == 0
    said = {one.id: one.faults[0].kind for one in suspects_of(root).values()}
    twin = {"c3", "c4"} & said.keys()
    assert len(twin) == 1 and said == {"c5": "jumps", twin.pop(): "duplicate"}
    page = (root / "clean.html").read_text()
    assert "default-src 'none'" in page and "<img" not in page
    assert page.count("motionloomChoices(document") == 1
    assert set(re.findall(r"<[a-z]+[^<>]*?\s(?:src|href)\s*=\s*[\"']?(.)", page)) <= {"#"}
    given = tmp_path / "decisions.json"
    given.write_text(json.dumps({"left_out": {"c5": "leaps"}, "kept": ["c4", "c3"]}))
    assert call("data", "clean", root, "--decisions", given).code == 0
    assert "c5" not in ShardDataset.open(root, "train").ids
    assert call("data", "clean", root).code == 0 and not suspects_of(root)
    assert "Nothing looks wrong" in (root / "clean.html").read_text()
    assert call("data", "clean", root, "--decisions", "none").code == 0
    assert "c5" in ShardDataset.open(root, "train").ids
    given.write_text('{"left": {}}')
    refused = call("data", "clean", root, "--decisions", given)
    assert refused.code == 2 and "decisions.json: unknown key 'left'" in refused.err


@pytest.mark.browser
def test_decide_and_save(
    root: Path, call: Callable[..., Any], browser: Any, until: Any, tmp_path: Path
) -> None:
    call("data", "clean", root)
    page = browser.new_page(viewport={"width": 1200, "height": 900}, accept_downloads=True)
    trouble: list[str] = []
    page.on("pageerror", lambda error: trouble.append(str(error)))
    page.goto((root / "clean.html").as_uri())
    until(page, "window.__viewer && window.__viewer.draws > 2")
    assert page.locator(".mlv-cell").count() == 3 and page.locator(".choice").count() == 2
    page.locator(".choice", has_text="leaps").get_by_text("Leave out").click()
    page.get_by_text("Keep the rest").click()
    assert page.locator(".choices output").text_content() == "2 of 2 decided: 1 left out, 1 kept"
    with page.expect_download() as saved:
        page.get_by_text("Save decisions").click()
    saved.value.save_as(tmp_path / "decisions.json")
    page.close()
    assert not trouble
    assert call("data", "clean", root, "--decisions", tmp_path / "decisions.json").code == 0
    assert sorted(ShardDataset.open(root, "train").ids) == ["c0", "c1", "c2", "c3", "c4"]
