"""Rivals that make motions of a given length: planned, trained, stopped, exported, generating; refusals."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from rich.console import Console
from safetensors.numpy import load_file

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.dances import dances_for, dances_of
from motionloom.pipeline.evaluation.figures import MODEL, FigureFile
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.clip_file import read_seed_motion
from motionloom.pipeline.inference.generation import generate
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.store.data import Data

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


# FACT and Bailando from a recipe to figures and files: trained, measured after their seed, exported.

TRAIN = "train: {steps: 4, batch_size: 8, checkpoint_every: 4, validate_every: 4}"
DANCES = f"""
extends: ude-small
name: dances
stages:
  fact:
    kind: fact
    net: {{dim: 16, heads: 2, ff: 16, layers: 1, motion_frames: 12, music_frames: 20, predicted_frames: 4}}
    {TRAIN}
  dance_vq:
    kind: dance_vq
    net: {{width: 8, depth: 1, halvings: 2, code_dim: 8, num_codes: 16, reset_below: 0.05}}
    window: 24
    root_start: 2
    {TRAIN}
  cross_gpt: {{kind: cross_gpt, net: {{dim: 16, heads: 2, ff: 16, layers: 1, context: 5}}, {TRAIN}}}
  actor_critic:
    kind: actor_critic
    reward: {{critic_layers: 1, actor_steps: 2, critic_steps: 2}}
    reward_songs: test
    {TRAIN}
  of_fact: {{kind: evaluate_dances, clips: 4, repeats: 1, inputs: {{generators: [fact]}}}}
  of_bailando: {{kind: evaluate_dances, clips: 4, repeats: 1, inputs: {{generators: [actor_critic]}}}}
  evaluate: null
  evaluate_dances: null
  generate: null
  report: null
"""


@pytest.fixture(scope="module")
def run(ude_run: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stages of DANCES, behind the data of the small UDE."""
    root = tmp_path_factory.mktemp("dances")
    shutil.copy(ude_run.recipe, root / "ude-small.yaml")
    (root / "dances.yaml").write_text(DANCES)
    shutil.copytree(ude_run.folder, root / "run")
    return run_recipe(root / "dances.yaml", root / "run", replace=True, console=Console(quiet=True))


def song(seconds: float) -> Sound:
    rng = np.random.default_rng(0)
    beats = (np.arange(round(seconds * 8000)) % 4000) < 800
    return Sound((0.2 * beats * rng.normal(size=len(beats))).clip(-1, 1).astype(np.float32), 8000)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "frames"), [("fact", 12), ("bailando", 4)])
def test_figures_are_of_what_follows_the_seed(name: str, frames: int, run: Path) -> None:
    found = FigureFile.read(run / f"stages/of_{name}/metrics.json").figures
    made = [figure for figure in found if figure.row == MODEL]
    assert {"beat_align.bailando", "position.ape_joints", "movement.fid_k"} <= {one.name for one in made}
    for figure in found:
        assert figure.protocol["seed_motion"] == f"the first {frames} frames of each recording"
        said = figure.protocol.get("note") == "rewarded on the songs of the test split"
        assert said == (name == "bailando")  # whose recipe here has the published setting


@pytest.mark.slow
def test_what_follows_the_first_frames_of_a_dance(run: Path) -> None:
    [clip] = dances_of(Data(run / "stages/data").split("test"), 1)
    rest = clip.after(10)
    assert np.array_equal(rest.joints, clip.joints[10:]) and np.array_equal(rest.motion, clip.motion[10:])
    assert rest.music is not None and clip.music is not None and np.array_equal(rest.music, clip.music[10:])
    assert rest.sound.seconds == pytest.approx(clip.sound.seconds - 0.5, abs=1e-3)
    np.testing.assert_allclose(rest.beats + 0.5, clip.beats[clip.beats >= 0.5])
    assert clip.after(0) is clip


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["fact", "actor_critic"])
def test_an_export_dances_from_its_own_seeds_or_given_ones(
    stage: str, run: Path, call: Callable[..., Any], tmp_path: Path
) -> None:
    done = call("export", run, "--out", tmp_path / "model")
    assert done.code == 0, done.err
    [only] = [one for one in Bundle.open(tmp_path / "model").stages if one.name == stage]
    bundle = Bundle([only], StageCache())
    maker = bundle.generator
    own = generate(bundle, Request.of(sounds=[song(3.0)] * 2, seed=1))
    assert [len(motion.joints) for motion in own] == [60, 60]
    [clip] = dances_for(bundle, Data(run / "stages/data").split("test"), 1, seconds=3.0, least=8)
    [made] = generate(
        bundle, Request.of(sounds=[clip.sound], seconds=clip.seconds, seed_motions=[clip.motion])
    )
    assert made.features.shape == (len(clip.motion), len(bundle.layout.part(maker.part)))
    if stage == "fact":
        begun = maker.capabilities.seed_frames
        np.testing.assert_allclose(
            made.features[:begun], clip.motion[-begun:][:, bundle.layout.part(maker.part)], atol=1e-4
        )
    short = clip.motion[: maker.capabilities.seed_frames - 1]
    with pytest.raises(UserError, match=f"{len(short)} frames"):
        generate(bundle, Request.of(sounds=[clip.sound], seed_motions=[short]))
    with pytest.raises(UserError, match="ask for more"):
        generate(bundle, Request.of(sounds=[clip.sound], seconds=maker.capabilities.seed_frames / 20))


@pytest.mark.slow
def test_a_clip_of_a_file_is_gone_on_from(run: Path, call: Callable[..., Any], tmp_path: Path) -> None:
    """The npz and BVH that `generate` writes, by a model that has FACT alone."""
    model = tmp_path / "run"
    shutil.copytree(run, model)
    for name in ("ude", "cross_gpt", "actor_critic", "of_fact", "of_bailando"):
        shutil.rmtree(model / "stages" / name)
    soundfile.write(tmp_path / "song.wav", song(2.0).samples, 8000)
    shown = ["--format", "npz,bvh", "--set", "plant_feet=false"]
    asked = ["generate", model, "--audio", tmp_path / "song.wav", *shown]
    done = call(*asked, "--out", tmp_path / "first")
    assert done.code == 0, done.err
    assert "training dance" in done.err
    for clip in sorted((tmp_path / "first").glob("*.[nb][pv][zh]")):
        done = call(*asked, "--out", tmp_path / "next", "--set", f"seed_motion={clip}")
        assert done.code == 0 and "training dance" not in done.err, done.err
        motion = read_seed_motion(clip, Bundle.open(model).layout)
        with np.load(next((tmp_path / "next").glob("*.npz")), allow_pickle=False) as file:
            begun = file["features"][:12]
        np.testing.assert_allclose(begun, motion[-12:, : begun.shape[1]], atol=1e-4)
    done = call(*asked, "--out", tmp_path / "next", "--set", f"seed_motion={tmp_path / 'song.wav'}")
    assert done.code == 2 and "song.wav" in done.err


@pytest.mark.slow
def test_a_seed_motion_that_nothing_goes_on_from_is_refused(ude_run: Any) -> None:
    bundle = Bundle.open(ude_run.folder)
    motion = np.zeros((20, bundle.layout.dim), np.float32)
    with pytest.raises(UserError, match="seed motion"):
        generate(bundle, Request.of(["a person walks"], seed_motions=[motion]))


@pytest.mark.slow
def test_bailando_dances_in_smpls_parameters(tmp_path: Path) -> None:
    """UDE's own format: its joints are posed by the neutral body."""
    _, _, own = DANCES.partition("  dance_vq:")
    shorter = own.replace(
        "  of_fact: {kind: evaluate_dances, clips: 4, repeats: 1, inputs: {generators: [fact]}}\n", ""
    )
    rest = "".join(f"  {name}: null\n" for name in ("text", "tma", "tokenizer", "utt", "dmd", "ude"))
    data = "  data: {clips: 24, max_seconds: 5.0, dances: {songs: 6, song_seconds: 6.0}}\n"
    head = "extends: ude-tiny-smpl75\nname: smpl\nstages:\n"
    (tmp_path / "smpl.yaml").write_text(f"{head}{data}{rest}  dance_vq:{shorter}")
    run = run_recipe(tmp_path / "smpl.yaml", tmp_path / "run", console=Console(quiet=True))
    assert FigureFile.read(run / "stages/of_bailando/metrics.json").figures
    [only] = [one for one in Bundle.open(run).stages if one.name == "actor_critic"]
    [made] = generate(Bundle([only], StageCache()), Request.of(sounds=[song(3.0)]))
    assert made.features.shape == (60, 75) and np.isfinite(made.joints).all()
