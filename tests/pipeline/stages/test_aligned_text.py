"""Captions as TMA's latents: what a token model reads in the place of words, in a run and exported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.runs.api import export_run, run_recipe
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.runs.recipe import load_recipe

pytestmark = pytest.mark.slow

QUIET = Console(quiet=True)
RECIPE = """
extends: ude-small
stages:
  tma:
    kind: tma
    net: {latent: 24, ff: 32, layers: 1, heads: 2}
    train: {steps: 4, batch_size: 8, checkpoint_every: 2, validate_every: 4}
  words: {kind: aligned_text}
  utt: {inputs: {text: words}, train: {steps: 4, checkpoint_every: 2, validate_every: 4}}
"""


@pytest.fixture(scope="module")
def run(ude_run: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("aligned")
    (folder / "ude-small.yaml").write_text(ude_run.recipe.read_text())
    (folder / "aligned.yaml").write_text(RECIPE)
    return run_recipe(folder / "aligned.yaml", folder / "run", select=Selection(until="ude"), console=QUIET)


def test_a_caption_is_one_latent(run: Path) -> None:
    stages, stage_cache = finished_stages(run), StageCache()
    words, text, tma = (stage_cache.get(stages[name]) for name in ("words", "text", "tma"))
    captions = sorted(words.cache.captions_by_key().values())
    assert captions == sorted(text.cache.captions_by_key().values()) and words.dim == words.cache.dim == 24
    tokens, mask = words.cache.tokens(captions)
    assert tokens.shape == (len(captions), 1, 24) and mask.all()
    latents = tma.embed_captions(captions, text.cache).numpy()
    # Tokens are kept in half precision: eleven bits.
    assert np.abs(tokens[:, 0] - latents).max() <= np.abs(latents).max() * 2**-11
    length = np.linalg.norm(latents, axis=1, keepdims=True)
    assert np.abs(words.cache.sentence(captions) - latents / length).max() < 1e-5
    # What means the same is what the sentences say, not the latents.
    assert np.array_equal(words.cache.similarity(captions), text.cache.similarity(captions))


def test_new_words_go_the_same_way(run: Path) -> None:
    stages, stage_cache = finished_stages(run), StageCache()
    words = stage_cache.get(stages["words"])
    captions = sorted(words.cache.captions_by_key().values())[:3]
    fresh, known = words.encoder.encode([*captions, "somebody sings"]), words.cache.tokens(captions)[0]
    assert fresh.tokens.shape == (4, 1, 24)
    assert np.abs(fresh.tokens[:3] - known).max() <= 2e-3 * np.abs(known).max()
    assert words.encoder.name == words.cache.encoder


def test_an_export_makes_the_same_motion(run: Path, tmp_path: Path) -> None:
    out = export_run(run, tmp_path / "model", console=QUIET)
    made = [
        Bundle.open(folder).generate(["a person waves"], seconds=2.0, seed=3)[0].features
        for folder in (run, out)
    ]
    assert np.array_equal(made[0], made[1]) and len(made[0]) == 40


def test_a_tma_of_other_words_is_refused(ude_run: Any, tmp_path: Path) -> None:
    (tmp_path / "ude-small.yaml").write_text(ude_run.recipe.read_text())
    wrong = RECIPE + "  other: {kind: text, inputs: {data: data}}\n"
    wrong = wrong.replace("words: {kind: aligned_text}", "words: {kind: aligned_text, inputs: {text: other}}")
    (tmp_path / "wrong.yaml").write_text(wrong)
    with pytest.raises(UserError, match=r"reads captions of 'other'.*inputs: \{text: text\}"):
        load_recipe(tmp_path / "wrong.yaml")
