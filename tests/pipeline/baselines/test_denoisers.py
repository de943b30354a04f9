"""Denoisers of bodies as stages, MDM and MotionDiffuse: planned, trained, stopped, exported, generating."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file

from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.inference.model import MotionModel

RECIPE = """
name: denoiser
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
defaults:
  trained: {train: {steps: STEPS, batch_size: 4, checkpoint_every: 1, validate_every: 2}}
stages:
  data: {kind: shards, path: ROOT/data}
  stats: {kind: stats}
  text: {kind: text}
  denoiser: DENOISER
"""
SIZES = "dim: 16, ff: 16, layers: 1, heads: 2"
KINDS = {
    "mdm": f"{{kind: mdm, net: {{{SIZES}}}}}",
    "inbetween": f"{{kind: inbetween, net: {{{SIZES}}}}}",
    "motiondiffuse": f"{{kind: motiondiffuse, max_frames: 40, net: {{{SIZES}, caption: {{{SIZES}}}}}}}",
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_stopped_training_goes_on_exactly_and_its_export_generates(
    kind: str, tmp_path: Path, call: Callable[..., Any]
) -> None:
    synthesize(SynthConfig(clips=10, fps=20, layout="wholebody313"), tmp_path / "data")

    def run(out: str, steps: int, *more: str) -> str:
        text = RECIPE.replace("ROOT", str(tmp_path)).replace("DENOISER", KINDS[kind])
        (tmp_path / "recipe.yaml").write_text(text.replace("STEPS", str(steps)))
        done = call("run", tmp_path / "recipe.yaml", "-o", tmp_path / out, *more)
        assert done.code == 0, done.err
        return str(done.out + done.err)

    assert "denoiser" in run("planned", 3, "--dry-run")
    run("whole", 3)
    shutil.copytree(tmp_path / "whole", tmp_path / "parts")
    shutil.rmtree(tmp_path / "parts/stages/denoiser")
    run("parts", 1)
    assert "step 1 to 3" in run("parts", 3)
    one, two = (
        load_file(tmp_path / f"{out}/stages/denoiser/model.safetensors") for out in ("whole", "parts")
    )
    assert one.keys() == two.keys() and all(np.array_equal(one[name], two[name]) for name in one)
    assert call("export", tmp_path / "whole", "-o", tmp_path / "model").code == 0
    made = []
    for place in ("whole", "model"):
        model = MotionModel.from_pretrained(tmp_path / place, device="cpu")
        sampling = {"denoising_steps": 3, "sampler": "ddim"}
        made.append(model.generate(["a person walks"] * 2, seconds=[0.5, 1.2], sampling=sampling))
        assert [motion.features.shape for motion in made[-1]] == [(10, 313), (24, 313)]
        with pytest.raises(UserError, match="give --seconds"):
            model.generate(["a person walks"])
    np.testing.assert_array_equal(made[0][1].features, made[1][1].features)
    if kind == "motiondiffuse":
        with pytest.raises(UserError, match=r"0\.05 to 2\.0 s"):
            model.generate(["a person walks"], seconds=2.1)
