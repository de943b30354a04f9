"""The page about a data set: what it says, that it hides nothing and trusts nothing, and how it plays."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shard_samples import LAYOUT, write_made

from motionloom.datasets.base.records import Caption, Dropped
from motionloom.datasets.motion.features.codec import encode
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import write_dataset
from motionloom.datasets.synth.generate import SynthConfig, make_clip, make_sample, split_of
from motionloom.pipeline.curation.clean_page import suspects_of
from motionloom.pipeline.results.data_page import to_watch, write_data_report

NASTY = "</script><script>window.hacked=1</script><img src=x onerror='window.hacked=1'><b>bold</b> & \"q\""
CONFIG = SynthConfig(clips=40, min_seconds=2.0, max_seconds=5.0)


def nasty_sample(index: int) -> Sample:
    sample = make_sample(index, CONFIG)
    texts = [Caption(text=f"{NASTY} {index}"), *sample.texts]
    if index % 2:
        texts.append(Caption(text="a person stands", tokens=["a/DET", "person/NOUN", "stand/VERB"]))
    meta = sample.meta.model_copy(
        update={"id": f"{sample.meta.id}{'<i>' * (index == 3)}", "licence": f"CC0{NASTY}"}
    )
    return replace(sample, meta=meta, texts=texts)


@pytest.fixture(scope="module")
def nasty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("nasty")
    dropped = [
        Dropped(source=f"take/{k}{NASTY}", reason=f"{k / 10:.2f} s, shorter than 1 s") for k in range(7)
    ]
    write_dataset(
        root,
        [(split_of(k, CONFIG), k) for k in range(CONFIG.clips)],
        nasty_sample,
        DatasetFacts(
            name="nasty",
            layout=CONFIG.motion_layout,
            licence="mixed",
            converter="synth",
            converter_version=7,
            options={"body_model": {"sentence": f"No body model. {NASTY}"}, "deep": {"er": [1, NASTY]}},
            dropped=[*dropped, Dropped(source="b", reason="NaN at frame 3")],
            audio={"rate": 30720, "name": NASTY},
            notes=[f"a note {NASTY}"],
        ),
        WriteOptions(progress=False),
    )
    return root


@pytest.fixture(scope="module")
def page(nasty: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "deep" / "report.html"
    write_data_report(nasty, path)
    return path


def test_nothing_of_the_data_becomes_markup(page: Path) -> None:
    text = page.read_text()
    assert list(page.parent.iterdir()) == [page] and len(text) < 3_000_000
    assert "<img" not in text and "<b>" not in text and "<i>" not in text.replace("<i style", "")
    assert "<script>window" not in text and "hacked=1" in text


def test_it_says_what_is_in_the_set(page: Path, nasty: Path) -> None:
    text = re.sub(r"<[^>]+>", " ", page.read_text().partition("<body>")[2].partition("<script")[0])
    for word in ("Data set nasty", "wholebody363 (exact)", "synth version 7", "40", "train", "val", "test"):
        assert word in text, word
    whole = page.read_text()
    dropped = ("8 clips of 48", "shorter than 1 s", "7 × … s", "NaN at frame 3", "1 × NaN at frame …")
    for word in (*dropped, "a note", "deep.er", "30720"):
        assert word in whole, word
    assert whole.count("<h1>") == 1 and whole.count("<h2") == 5
    assert re.search(r"<dt>captions</dt><dd>180</dd>", whole), "40 clips of 4, and every other one more"


def test_the_same_data_give_the_same_page(page: Path, nasty: Path, tmp_path: Path) -> None:
    write_data_report(nasty, tmp_path / "again.html")
    assert (tmp_path / "again.html").read_bytes() == page.read_bytes()


def test_clips_to_watch_differ(nasty: Path) -> None:
    opened = {split: ShardDataset.open(nasty, split) for split in ("train", "val", "test")}
    chosen = to_watch(opened, 12)
    assert len({motion.caption for motion in chosen}) == 12, "no caption twice while there are others"
    assert len({motion.label.split(" ")[0] for motion in chosen}) > 1, "of several splits"
    assert len(to_watch(opened, 100)) == 40
    assert chosen[0].fps == 20 and chosen[0].face_controls is not None
    assert chosen[0].face_controls.shape == (len(chosen[0].joints), 5)


def raw_sample(index: int, layout: MotionLayout) -> Sample:
    rng = np.random.default_rng(index)
    motion = 0.1 * np.cumsum(rng.standard_normal((40 + index, layout.dim)), axis=0).astype(np.float32) / 8
    meta = layout.clip_meta(
        f"raw-{index}", source="made", split="train", frames=len(motion), licence="", has_hands=False
    )
    return Sample(meta, motion)


@pytest.mark.parametrize("name", ["smpl75", "smplx322"])
def test_raw_sets_without_captions_have_a_page(name: str, tmp_path: Path) -> None:
    layout = MotionLayout.named(name)
    write_made(tmp_path, [("train", k) for k in range(3)], partial(raw_sample, layout=layout), layout)
    write_data_report(tmp_path, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert "No clip has" in text and "neutral skeleton" in text and "none stated" in text
    assert "None: every clip" in text


def test_commands(call: Callable[..., Any], nasty: Path, tmp_path: Path) -> None:
    copied = shutil.copytree(nasty, tmp_path / "set")
    done = call("data", "report", copied)
    assert done.code == 0 and (copied / "report.html").is_file()
    assert call("data", "check", copied).code == 0  # the page does not disturb the set
    strict = call("data", "check", copied, "--strict")
    assert strict.code == 1 and "warning: " in strict.out and "40 licence" in strict.out


# `data clean` as a command and as a page: suspects listed and shown, decisions saved, applied and undone.

CLEANED = SynthConfig(clips=6, seed=3, layout="body133", max_seconds=5)
CURSED = "</script><img src=x onerror=hacked=1>"


def convert(index: int) -> Sample:
    """Clip 4 is clip 3 again; clip 5 leaps."""
    joints = make_clip(min(index, 3) if index < 5 else 5, CLEANED).joints
    if index == 5:
        joints[20:, :, 0] += 0.4
    motion = encode(joints, LAYOUT)
    meta = LAYOUT.clip_meta(f"c{index}", source="s", split="train", frames=len(motion), licence="CC0")
    return Sample(meta, motion, texts=[Caption(text=f"{index} {CURSED}")])


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_made(tmp_path / "set", [("train", k) for k in range(6)], convert)


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


# A run that was trained, whole and with stages taken away: its report.


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


@pytest.mark.slow
def test_the_report_of_a_finished_run(small_run: Any) -> None:
    text = text_of(small_run.folder / "stages/report/report.html")
    for words in ("Figures on held-out clips", "Settings of every", "52 joints at 20 "):
        assert words in text, words
    assert "in training" not in text and "Still missing" not in text


@pytest.mark.slow
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
