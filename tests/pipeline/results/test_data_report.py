"""The page about a data set: what it says, that it hides nothing and trusts nothing, and how it plays."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.datasets.schema import Caption, Dropped
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import write_dataset
from motionloom.datasets.synth.generate import SynthConfig, make_sample, split_of
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
    write_dataset(
        tmp_path,
        [("train", k) for k in range(3)],
        partial(raw_sample, layout=layout),
        DatasetFacts("raw", layout, licence="x", converter="made", converter_version=1, options={}),
        WriteOptions(progress=False),
    )
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
