"""TEMOS makes motion: TMA's network without InfoNCE, of a given length (HumanTOMATO Table 1)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from motionloom.pipeline.evaluation.figures import MODEL, FigureFile
from motionloom.pipeline.inference.generators.vae import between
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.runs.api import run_recipe

RECIPE = """
extends: humantomato-tiny
name: temos
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data: {clips: 48}
  tma: {net: {latent: 8, ff: 16, layers: 1}, train: {steps: 2, batch_size: 4}}
  temos:
    kind: tma
    net: {latent: 32, ff: 64, layers: 1, heads: 4, frame_stride: 4, norm: post}
    loss: {contrastive: 0.0}
    optim: {lr: 2.0e-3}
    train: {steps: 60, batch_size: 16}
  tokenizer: null
  tokens: null
  gpt: null
  face_tokenizer: null
  face_tokens: null
  face_gpt: null
  generate: {count: 2, formats: [npz]}
  report: {count: 1}
  evaluate: {repeats: 2, size: 4, lengths: LENGTHS}
"""


def test_frames_between_are_on_the_line() -> None:
    values = np.array([[0.0], [4.0], [2.0]], dtype=np.float32)
    assert between(values, 9, 4)[:, 0].tolist() == [0, 1, 2, 3, 4, 3.5, 3, 2.5, 2]
    assert between(values, 11, 4)[:, 0].tolist()[-3:] == [2, 2, 2]
    assert between(values, 6, 4)[:, 0].tolist() == [0, 1, 2, 3, 4, 4], "of 6 frames the third is never read"
    assert between(values, 3, 1) is not values and between(values, 2, 1)[:, 0].tolist() == [0, 4]


@pytest.mark.slow
def test_temos_generates_and_is_evaluated(tmp_path: Path, call: Callable[..., Any]) -> None:
    (tmp_path / "recipe.yaml").write_text(RECIPE.replace("LENGTHS", "recorded"))
    run_recipe(tmp_path / "recipe.yaml", tmp_path / "run", console=Console(quiet=True))
    file = FigureFile.read(tmp_path / "run/stages/evaluate/metrics.json")
    found = {one.name: one.value for one in file.figures if one.row == MODEL}
    assert found["tma.multimodality"] > 0, "two draws of the latent"
    assert found["tma.fid"] > 0 and found["tma.t2m_r1"] <= 1
    model = MotionModel.from_pretrained(tmp_path / "run", device="cpu")
    one, two = model.generate(["a person waves"] * 2, seconds=[1.5, 2.05], seed=1)
    assert [len(motion.joints) for motion in (one, two)] == [30, 41]
    assert np.isfinite(one.joints).all() and np.abs(one.joints[:30] - two.joints[:30]).max() > 1e-4
    done = call("generate", tmp_path / "run", "a person waves", "-o", tmp_path / "out", "-f", "npz")
    assert done.code == 2 and "give --seconds" in done.err and done.err.count("\n") == 1
    shown = sorted((tmp_path / "run/stages/generate/motions").glob("*.npz"))
    assert [len(np.load(path, allow_pickle=False)["joints"]) >= 30 for path in shown] == [True, True], (
        "as long as the clips"
    )
    assert "generated" in (tmp_path / "run/stages/report/report.html").read_text()
    (tmp_path / "recipe.yaml").write_text(RECIPE.replace("LENGTHS", "free"))
    done = call("run", tmp_path / "recipe.yaml", "-o", tmp_path / "run")
    assert done.code == 2 and "lengths: recorded" in done.err
