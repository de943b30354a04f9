"""Faces judged by a TMA of faces, motion beside what was recorded for its caption."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.figures import MODEL, TRAINING, FigureFile
from motionloom.pipeline.evaluation.truth import reconstruct_all, spread_any, truth_of
from motionloom.pipeline.results.paper.compare import compare_with_paper
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.plan import Selection

RECIPE = """
extends: small
name: small
stages:
  face_evaluator:
    kind: tma
    part: face
    net: {latent: 8, ff: 16, layers: 1, frame_stride: 1}
    loss: {contrastive: 0.1}
    train: {steps: 4, batch_size: 8, checkpoint_every: 4, validate_every: 4}
  evaluate: {clips: 9, repeats: 2, size: 4}
  # As in the recipes of the baselines.
  evaluate_face_vae:
    kind: evaluate
    clips: 9
    repeats: 1
    size: 4
    inputs: {tokenizer: null, face_tokenizer: null, tma: null, generators: [gpt, face_vae]}
  evaluate_face_diffusion:
    kind: evaluate
    clips: 9
    repeats: 1
    size: 4
    inputs: {tokenizer: null, face_tokenizer: null, tma: null, generators: [gpt, face_diffusion]}
"""


@pytest.fixture(scope="module")
def judged(small_run: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with an evaluator of faces, evaluated by it."""
    root = tmp_path_factory.mktemp("faces")
    shutil.copy(small_run.recipe, root / small_run.recipe.name)
    (root / "faces.yaml").write_text(RECIPE)
    shutil.copytree(small_run.folder, root / "run")
    wanted = "evaluate,evaluate_face_vae,evaluate_face_diffusion"
    run_recipe(root / "faces.yaml", root / "run", select=Selection(until=wanted), console=Console(quiet=True))
    return root


@pytest.mark.slow
def test_faces_have_a_judge(judged: Path) -> None:
    file = FigureFile.read(judged / "run/stages/evaluate/metrics.json")
    made = {one.name: one.value for one in file.figures if one.row == MODEL}
    tops = {f"face_evaluator.{name}" for name in ("top-1", "top-2", "top-3", "matching_score")}
    assert tops <= made.keys() and made["face_evaluator.fid"] > 0
    assert file.about["judges"]["face_evaluator"]["stage"] == "face_evaluator"
    others = file.of("reconstruction.face_evaluator.fid", TRAINING)
    assert others is not None and others.value > 0 and made["reconstruction.face_evaluator.fid"] > 0
    assert 0 <= made["reconstruction.face_evaluator.top-3"] <= 1
    top = file.of("face_evaluator.top-1")
    assert top is not None and (top.protocol["clips"], top.protocol["candidates"]) == (7, 4)
    # By hand: one clip's expressions.
    stages, stage_cache = finished_stages(judged / "run"), StageCache()
    data, tokenizer = stage_cache.get(stages["data"]).split("test"), stage_cache.get(stages["face_tokenizer"])
    errors, frames = 0.0, 0
    for truth in (truth_of(data, index) for index in spread_any(data, 9)):
        if truth.face is not None:
            rebuilt = reconstruct_all(tokenizer, truth)[:, data.layout.slice("face")].astype(np.float64)
            errors += np.sqrt(np.square(rebuilt - truth.face).sum(-1)).sum()
            frames += len(rebuilt)
    assert made["face.expression"] == pytest.approx(errors / frames, abs=2e-5)


@pytest.mark.slow
def test_each_facial_generator_has_a_row(judged: Path) -> None:
    (found,) = compare_with_paper("humantomato/4", [judged / "run"])
    ours = {row.method: row for row in found.rows if row.source == "ours"}
    assert set(ours) == {"cVAE", "Diffusion", "Ours"}
    for row in ours.values():
        assert all(cell is not None for cell in row.cells[:6]), row
    assert len({ours[method].cells[0].text for method in ours}) == 3  # type: ignore[union-attr]
