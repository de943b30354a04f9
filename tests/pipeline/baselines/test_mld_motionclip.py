"""MLD and MotionCLIP by a recipe: trained, resumed, evaluated, exported, generated from; refusals."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.lookup import finished_stages, open_exported
from motionloom.pipeline.contract.stage import CompletedStage, StageCache
from motionloom.pipeline.evaluation.figures import MODEL, FigureFile
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.runs.api import export_run, run_recipe

RECIPE = """
name: mld
seed: 3
hardware: {accelerator: cpu, devices: 1, threads: 1, convert_workers: 1, loggers: []}
defaults:
  trained: {train: {steps: 6, batch_size: 4, checkpoint_every: 3, validate_every: 3}}
stages:
  data: {kind: synth, clips: 32, fps: 20, min_seconds: 2.0, max_seconds: 5.0, actions: [walk, kick]}
  stats: {kind: stats}
  text: {kind: text}
  tma: {kind: tma, net: {latent: 16, ff: 16, layers: 1, frame_stride: 4}}
  motion_vae:
    kind: motion_vae
    net: {dim: 16, ff: 32, layers: 3, heads: 2, latent_tokens: 2}
    max_frames: 60
  mld:
    kind: latent_diffusion
    net: {dim: 16, ff: 32, layers: 1, heads: 2, time_waves: 16, schedule: {steps: 20}}
    max_frames: 60
  motionclip:
    kind: motionclip
    net: {latent: 384, ff: 16, layers: 1, heads: 2}
  evaluate:
    kind: evaluate
    repeats: 1
    size: 4
    clips: 6
    lengths: recorded
    sampling: {cfg_scale: 2.0, denoising_steps: 4}
    inputs: {generators: [mld]}
"""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mld")
    (folder / "recipe.yaml").write_text(RECIPE)
    return run_recipe(folder / "recipe.yaml", folder / "run", console=Console(quiet=True))


def of(stages: Iterable[CompletedStage], name: str) -> Bundle:
    """One generator alone, of a run that has several."""
    return Bundle([stage for stage in stages if stage.name == name], StageCache())


def test_mld_is_evaluated(run: Path) -> None:
    """Clips of the data are longer than what it makes: they are made at the longest."""
    figures = FigureFile.read(run / "stages/evaluate/metrics.json").figures
    found = {one.name: one.value for one in figures if one.row == MODEL}
    assert found["tma.fid"] > 0 and np.isfinite(list(found.values())).all()


@pytest.fixture(scope="module")
def exported(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported") / "export"
    export_run(run, folder, console=Console(quiet=True))
    return folder


@pytest.mark.parametrize("name", ["mld", "motionclip"])
def test_motion_of_the_length_asked_for_also_by_an_export(name: str, run: Path, exported: Path) -> None:
    texts, seconds = ["a person walks", "a person kicks"], [1.5, 2.05]
    bundle = of(finished_stages(run).values(), name)
    made = bundle.generate(texts, seconds=seconds, seed=1)
    assert [len(motion.joints) for motion in made] == [30, 41]
    assert all(np.isfinite(motion.joints).all() for motion in made)
    again = of(open_exported(exported), name).generate(texts, seconds=seconds, seed=1)
    for one, other in zip(made, again, strict=True):
        np.testing.assert_array_equal(one.joints, other.joints)
    with pytest.raises(UserError, match="give --seconds"):
        bundle.generate(texts)
    with pytest.raises(UserError, match="out of reach"):
        bundle.generate(texts, seconds=5.1)


@pytest.mark.parametrize("stage", ["motion_vae", "mld", "motionclip"])
def test_going_on_from_a_checkpoint_ends_with_the_same_bytes(stage: str, run: Path, tmp_path: Path) -> None:
    again = tmp_path / "run"
    shutil.copytree(run, again)
    folder = again / "stages" / stage
    for name in ("artifact.json", "model.json", "model.safetensors", "checkpoints/step=00000006.ckpt"):
        (folder / name).unlink()
    run_recipe(run.parent / "recipe.yaml", again, console=Console(quiet=True))
    for name in ("artifact.json", "model.safetensors"):
        assert (folder / name).read_bytes() == (run / "stages" / stage / name).read_bytes()


def test_a_dry_run_knows_its_sizes(run: Path, call: Callable[..., Any], tmp_path: Path) -> None:
    done = call("run", run.parent / "recipe.yaml", "-o", tmp_path / "run", "--dry-run")
    assert done.code == 0 and "2 latents of 16" in done.out


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("mld.net.dim=32", "net.dim 32"),
        ("mld.max_frames=50", "max_frames 50"),
        ("motion_vae.max_frames=498", "net.positions is 500"),
        ("motion_vae.net.layers=4", "layers 4 must be odd"),
        ("motion_vae.part=face", "part"),
        ("motionclip.net.latent=64", "net.latent 64"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_runs(change: str, says: str, run: Path) -> None:
    with pytest.raises(UserError, match=says):
        recipe, quiet = run.parent / "recipe.yaml", Console(quiet=True)
        run_recipe(recipe, run, overrides=[change], dry_run=True, console=quiet)
