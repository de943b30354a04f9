"""Rivals that make motions of a given length: planned, trained, stopped, exported, generating; refusals."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from safetensors.numpy import load_file

from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.runs.api import run_recipe

RECIPE = """
name: made
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
defaults:
  trained: {train: {steps: STEPS, batch_size: 4, checkpoint_every: 1, validate_every: 2}}
stages:
  data: {kind: shards, path: ROOT/data}
  stats: {kind: stats}
  text: {kind: text}
"""
SIZES = "dim: 16, ff: 16, layers: 1, heads: 2"
VAE = f"{{kind: motion_vae, train: {{steps: 1}}, max_frames: 40, net: {{{SIZES}, latent_tokens: 2}}}}"
KINDS = {
    "mdm": f"made: {{kind: mdm, net: {{{SIZES}}}}}",
    "inbetween": f"made: {{kind: inbetween, net: {{{SIZES}}}}}",
    "motiondiffuse": f"made: {{kind: motiondiffuse, max_frames: 40, net: {{{SIZES}, caption: {{{SIZES}}}}}}}",
    "mld": f"motion_vae: {VAE}\n  made: {{kind: latent_diffusion, max_frames: 40, net: {{{SIZES}}}}}",
    "motionclip": "made: {kind: motionclip, net: {latent: 384, ff: 16, layers: 1, heads: 2}}",
    "temos": "made: {kind: tma, net: {latent: 8, ff: 16, layers: 1, heads: 2, frame_stride: 4}, "
    "loss: {contrastive: 0}}",
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_stopped_training_goes_on_exactly_and_its_export_generates(
    kind: str, tmp_path: Path, call: Callable[..., Any]
) -> None:
    synthesize(SynthConfig(clips=10, fps=20, layout="wholebody313"), tmp_path / "data")

    def run(out: str, steps: int, *more: str) -> str:
        text = f"{RECIPE.replace('ROOT', str(tmp_path))}  {KINDS[kind]}\n"
        (tmp_path / "recipe.yaml").write_text(text.replace("STEPS", str(steps)))
        done = call("run", tmp_path / "recipe.yaml", "-o", tmp_path / out, *more)
        assert done.code == 0, done.err
        return str(done.out + done.err)

    assert ("2 latents of 16" if kind == "mld" else "made") in run("planned", 3, "--sizes")
    run("whole", 3)
    shutil.copytree(tmp_path / "whole", tmp_path / "parts")
    shutil.rmtree(tmp_path / "parts/stages/made")
    run("parts", 1)
    assert "continues from step 1 of 3" in run("parts", 3)
    one, two = (load_file(tmp_path / f"{out}/stages/made/model.safetensors") for out in ("whole", "parts"))
    assert one.keys() == two.keys() and all(np.array_equal(one[name], two[name]) for name in one)
    assert call("export", tmp_path / "whole", "-o", tmp_path / "model").code == 0
    made = []
    for place in ("whole", "model"):
        model = MotionModel.from_pretrained(tmp_path / place, device="cpu")
        sampling = {} if kind in ("motionclip", "temos") else {"denoising_steps": 3, "sampler": "ddim"}
        made.append(model.generate(["a person walks"] * 2, seconds=[0.5, 1.2], sampling=sampling))
        assert [motion.features.shape for motion in made[-1]] == [(10, 313), (24, 313)]
        with pytest.raises(UserError, match=r"give --seconds.*lengths: recorded"):
            model.generate(["a person walks"])
    np.testing.assert_array_equal(made[0][1].features, made[1][1].features)
    if kind in ("motiondiffuse", "mld"):
        with pytest.raises(UserError, match=r"0\.05 to 2\.0 s"):
            model.generate(["a person walks"], seconds=2.1)


FITTING = (
    RECIPE.replace("STEPS", "1").replace("shards, path: ROOT/data", "synth, clips: 32, fps: 20")
    + f"""
  motion_vae: {VAE.replace("layers: 1", "layers: 3")}
  mld: {{kind: latent_diffusion, max_frames: 40, net: {{{SIZES}}}}}
  motionclip: {{kind: motionclip, net: {{latent: 384, ff: 16, layers: 1, heads: 2}}}}
"""
)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("mld.net.dim=32", "net.dim 32"),
        ("mld.max_frames=30", "max_frames 30"),
        ("motion_vae.max_frames=498", "net.positions is 500"),
        ("motion_vae.net.layers=4", "layers 4 must be odd"),
        ("motion_vae.part=face", "part"),
        ("motionclip.net.latent=64", "net.latent 64"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_runs(change: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "recipe.yaml").write_text(FITTING)
    with pytest.raises(UserError, match=says):
        run_recipe(
            tmp_path / "recipe.yaml", tmp_path / "run", overrides=[change], dry_run=True,
            console=Console(quiet=True),
        )  # fmt: skip
