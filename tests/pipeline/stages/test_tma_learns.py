"""What TMA is for (HumanTOMATO section 4.5): captions that read alike but move apart are told apart."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from rich.console import Console

from motionloom.datasets.text.encoder import load_text_encoder
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.retrieval import retrieve
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.plan import Selection

pytestmark = pytest.mark.slow

RECIPE = """
name: circles
seed: 1
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data:
    kind: synth
    clips: 240
    layout: body133
    min_seconds: 2.0
    max_seconds: 5.0
    actions: [walk]
  stats: {kind: stats}
  text: {kind: text}
  tma:
    kind: tma
    net: {latent: 48, ff: 96, layers: 2, heads: 4, dropout: 0.0, attention_dropout: 0.0, frame_stride: 4}
    optim: {lr: 1.0e-3, warmup_steps: 10, schedule: cosine}
    train: {steps: 150, batch_size: 32, checkpoint_every: 150, validate_every: 0}
"""
PAIRS = [
    ("a person walks in a clockwise circle", "a person walks in a counter-clockwise circle"),
    ("a person walks forward", "a person walks backward"),
]


def cosine(vectors: torch.Tensor) -> float:
    return float(torch.nn.functional.cosine_similarity(vectors[0], vectors[1], dim=0))


def test_tma_tells_apart_what_the_sentence_encoder_does_not(tmp_path: Path) -> None:
    recipe = tmp_path / "circles.yaml"
    recipe.write_text(RECIPE)
    run = tmp_path / "run"
    run_recipe(recipe, run, select=Selection(until="tma"), console=Console(quiet=True))
    tma, encoder = StageCache().get(finished_stages(run)["tma"]), load_text_encoder("minilm")
    for pair in PAIRS:
        encoded = encoder.encode(list(pair))
        sentence = cosine(torch.as_tensor(encoded.sentence))
        aligned = cosine(tma.embed_text(torch.as_tensor(encoded.tokens), torch.as_tensor(encoded.mask)))
        assert sentence > 0.8, "to the sentence encoder they are nearly the same"
        assert aligned < sentence - 0.5, f"{pair}: TMA {aligned:.2f}, sentence encoder {sentence:.2f}"
    # Twelve kinds of walk among 32 clips: a guess finds 3 % (10 % within three).
    found = retrieve(run)
    for name in ("D.t2m/R@3", "D.m2t/R@3"):
        figure = found.of(name)
        assert figure is not None and figure.value > 0.4
