"""A run on clips of which some lack captions, face captions or hands, and some have captions of parts."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from motionloom.datasets.schema import Caption, Split
from motionloom.datasets.shards.options import DatasetFacts, WriteOptions
from motionloom.datasets.shards.sample import Sample
from motionloom.datasets.shards.writer import write_dataset
from motionloom.datasets.synth.generate import SynthConfig, make_sample

COUNT = 24

RECIPE = """
extends: humantomato-tiny
name: mixed
seed: 3
hardware: {{accelerator: cpu, threads: 1, convert_workers: 1}}
stages:
  data: {{kind: shards, path: {path}}}
  tokenizer:
    net: {{width: 16, depth: 1, code_dim: 8, num_codes: 16}}
    train: {{steps: 2, batch_size: 4, checkpoint_every: 2, validate_every: 2}}
  face_tokenizer:
    net: {{width: 8, depth: 1, code_dim: 8, num_codes: 8}}
    train: {{steps: 2, batch_size: 4, checkpoint_every: 2, validate_every: 2}}
  tma: {{net: {{latent: 16, ff: 16, layers: 1}}, train: {{steps: 2, batch_size: 4, checkpoint_every: 2}}}}
  gpt: {{net: {{layers: 1, dim: 20, ff: 16}}, train: {{steps: 4, batch_size: 4, checkpoint_every: 2}}}}
  face_gpt: {{net: {{layers: 1, dim: 16, ff: 16}}, train: {{steps: 2, batch_size: 4, checkpoint_every: 2}}}}
  generate: {{count: 1}}
  evaluate: {{clips: 8, repeats: 1, size: 2}}
  report: {{count: 1}}
"""


CONFIG = SynthConfig(clips=COUNT, fps=20, min_seconds=2.0, max_seconds=5.0)


def split_of(i: int) -> Split:
    return "test" if i % 3 == 2 else "train"


def sample(i: int) -> Sample:
    """Every second clip has captions, of which every second one is about its first second; a third lacks
    face captions, a quarter hands.
    """
    made = make_sample(i, CONFIG)
    texts = [] if i % 2 else [replace_end(c, 1.0 if i % 4 else None) for c in made.texts]
    meta = made.meta.model_copy(update={"split": split_of(i), "has_hands": i % 8 > 1})
    return replace(made, meta=meta, texts=texts, face_texts=[] if i % 9 < 3 else made.face_texts)


def replace_end(caption: Caption, end: float | None) -> Caption:
    return caption.model_copy(update={"end": end})


def test_every_stage_takes_a_mixed_data_set(tmp_path: Path, call: Callable[..., Any]) -> None:
    write_dataset(
        tmp_path / "shards",
        [(split_of(i), i) for i in range(COUNT)],
        sample,
        DatasetFacts("mixed", CONFIG.motion_layout, "CC0", converter="test", converter_version=1, options={}),
        WriteOptions(progress=False),
    )
    recipe = tmp_path / "mixed.yaml"
    recipe.write_text(RECIPE.format(path=tmp_path / "shards"))
    done = call("run", recipe, "--out", tmp_path / "run")
    assert done.code == 0, done.out + done.err
    captioned = {
        split: sum(split_of(i) == split and not i % 2 for i in range(COUNT)) for split in ("train", "test")
    }
    for split, count in captioned.items():
        left = sum(split_of(i) == split for i in range(COUNT)) - count
        assert f"{split}: {left} clips without a caption are left out" in done.out
    assert "train: 6 clips without a face caption are left out" in done.out
    figures = json.loads((tmp_path / "run/stages/evaluate/metrics.json").read_text())
    assert {facts["clips"] for facts in figures["protocol"].values()} >= {captioned["test"]}
    log = (tmp_path / "run/stages/gpt/metrics.jsonl").read_text()
    assert "NaN" not in log
