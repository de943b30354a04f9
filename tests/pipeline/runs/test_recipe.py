"""Recipes: reading, overriding, refusing."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from rich.console import Console

from motionloom.datasets.schema import UserError
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.estimate import estimate
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.runs.shipped import shipped_recipes
from motionloom.pipeline.store.yaml import read_yaml


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "recipe.yaml"
    path.write_text(text)
    return path


BASE = """
name: small
stages:
  data: {kind: synth, clips: 8}
  stats: {kind: stats}
"""


@pytest.mark.parametrize("name", sorted({*shipped_recipes()} - {"finetune"}))  # test_finetune.py
def test_shipped_recipes_load_and_reload(name: str, tmp_path: Path) -> None:
    recipe = load_recipe(name)
    assert recipe.description
    assert load_recipe(write(tmp_path, recipe.to_yaml())) == recipe


def test_shipped_recipes_are_named_by_folder_and_size() -> None:
    for name, path in shipped_recipes().items():
        if name == "finetune":  # of no family, at the top
            assert read_yaml(path)["name"] == name == path.stem and path.parent.name == "configs"
            continue
        assert read_yaml(path)["name"] == name == f"{path.parent.name}-{path.stem}"
        assert load_recipe(f"{path.parent.name}/{path.stem}").name == name


@pytest.mark.parametrize("name", sorted(name for name in shipped_recipes() if name.startswith("ude-")))
def test_sizes_of_ude_are_known_before_it_runs(name: str) -> None:
    recipe = load_recipe(name)
    cards = estimate(recipe)
    decoded_by_tokenizer = name.endswith(("vq-decoder", "gru"))
    assert set(cards) == {stage.name for stage in recipe.stages if stage.kind.trains} >= {"tokenizer", "utt"}
    assert ("dmd" in cards) == (not decoded_by_tokenizer)
    assert cards["utt"].note == "40 code + 1 End for 160 frames"
    for stage in recipe.stages:
        stage.config.require_fit(recipe.hardware)


def test_ablations_of_ude_change_what_they_are_named_for() -> None:
    """Tables 3 to 5; beside what is named, the recipes of a size are equal."""
    for size in ("tiny", "paper"):
        base, gru = load_recipe(f"ude-{size}"), load_recipe(f"ude-{size}-gru")
        assert base.stage("ude").config.inject_z  # type: ignore[attr-defined]
        assert "dmd" in base.stage("ude").inputs
        for name in ("no-z", "no-z-vq-decoder", "vq-decoder"):
            recipe = load_recipe(f"ude-{size}-{name}")
            config = recipe.stage("ude").config
            assert config.inject_z == (name == "vq-decoder")  # type: ignore[attr-defined]
            assert ("dmd" in recipe.stage("ude").inputs) == (name == "no-z")
            trained = {stage.name: stage for stage in recipe.stages if stage.kind.trains}
            assert all(stage == base.stage(name) for name, stage in trained.items())
        assert gru.stage("utt").config.net == base.stage("utt").config.net.model_copy(  # type: ignore[attr-defined]
            update={"kind": "gru"}
        )


def test_override_changes_one_value() -> None:
    plain = load_recipe("humantomato-tiny")
    changed = load_recipe("humantomato-tiny", ["tma.optim.lr=1e-3"])
    assert changed.stage("tma").config.optim.lr == 1e-3  # type: ignore[attr-defined]
    same = [s for s in changed.stages if s.name != "tma"]
    assert same == [s for s in plain.stages if s.name != "tma"]


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("tma.optim.lrr=1", "did you mean 'lr'"),
        ("tmaa.optim.lr=1", "did you mean 'tma'"),
        ("tma.optim.lr", "stage.field=value"),
        ("tma.optim.lr=fast", "optim.lr"),
        ("tma.train.steps=0", "train.steps"),
        ("hardware.device=2", "did you mean 'hardware.devices'|did you mean 'devices'"),
        ("tma.kind=tmaa", "is no stage kind; did you mean 'tma'"),
        ("gpt.net.heads=7", "with --set: stages.gpt: .*dim 160 must be a multiple of heads 7"),
        ("tma.net.heads=3", "latent 128 must be a multiple of heads 3"),
        ("tokenizer.inputs.data=null", "stage 'tokenizer' needs a stage 'None'"),
    ],
)
def test_wrong_overrides_name_the_key_and_the_fix(override: str, says: str) -> None:
    with pytest.raises(UserError, match=says):
        load_recipe("humantomato-tiny", [override])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name: x\nstages: {stats: {kind: stats}}", "needs a stage 'data'"),
        (
            "name: x\nstages: {data: {kind: synth}, stats: {kind: stats, inputs: {dat: data}}}",
            "unknown role 'dat'",
        ),
        ("name: x\nstage: {}", "unknown key 'stage'; did you mean 'stages'"),
        ("name: ../x\nstages: {}", "name"),
        ("name: x\nstages: {../../victim: {kind: stats}}", "stage name '../../victim'"),
        ("name: x\nstages: {/tmp/victim: {kind: stats}}", "stage name '/tmp/victim'"),
        ("[1, 2]", "mapping"),
        ("a: [", "not valid YAML"),
        ("extends: recipe\nname: x", "circle"),
        (
            "name: x\nstages: {data: {kind: synth}, stats: {kind: stats}, text: {kind: text}, "
            "face_vae: {kind: tma, part: face, net: {frame_stride: 2}}}",
            "frame_stride must be 1",
        ),
    ],
)
def test_wrong_recipes_are_refused(text: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=says):
        load_recipe(write(tmp_path, text))


def test_unknown_recipe_names_the_nearest() -> None:
    with pytest.raises(UserError, match="did you mean 'humantomato-tiny'"):
        load_recipe("humantomato-tin")


def test_extends_merges_into_the_base(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(BASE)
    recipe = load_recipe(write(tmp_path, "extends: base\nname: child\nstages: {data: {clips: 9}}"))
    assert recipe.name == "child"
    assert recipe.stage("data").config.clips == 9  # type: ignore[attr-defined]
    assert [s.name for s in recipe.stages] == ["data", "stats"]


CAPTIONED = """
name: two-encoders
stages:
  data: {kind: synth, clips: 8}
  stats: {kind: stats}
  text: {kind: text}
  clip: {kind: text, encoder: some-clip}
  tma: {kind: tma}
  tokenizer: {kind: h2vq}
  tokens: {kind: tokens}
  gpt: {kind: gpt, prior: sentence, inputs: {text: clip}}
"""


def test_a_tma_on_captions_of_another_encoder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match=r"'gpt' reads captions as 'clip' .* its TMA 'tma' .* those of 'text'"
    ):
        load_recipe(write(tmp_path, CAPTIONED))
    for change in (("inputs: {text: clip}", "inputs: {text: clip, tma: null}"), ("some-clip", "minilm")):
        load_recipe(write(tmp_path, CAPTIONED.replace(*change)))


@pytest.mark.parametrize("override", ["tokenizer.net.reset_below=1.0", "tokenizer.net.num_codes=8192"])
def test_a_codebook_too_large_for_its_batches_is_refused(override: str, tmp_path: Path) -> None:
    for dry_run in (True, False):
        with pytest.raises(UserError, match=r"stage tokenizer: .*net.reset_below to 0\.\d+ or less"):
            run_recipe(
                "humantomato-tiny",
                tmp_path,
                overrides=[override],
                dry_run=dry_run,
                console=Console(quiet=True),
            )
    assert not list(tmp_path.rglob("artifact.json")), "refused before anything ran"


def test_a_codebook_of_mq_is_reset_only_if_averages_learn_it() -> None:
    """256 vectors a batch, 256 codes: a threshold of 1 would reset codes for ever, a gradient resets none."""
    sets = ["tokenizer.net.reset_below=1.0"]
    with pytest.raises(UserError, match=r"256 codes gets 256 vectors .*net.reset_below to 0\.25 or less"):
        recipe = load_recipe("ude-tiny", sets)
        recipe.stage("tokenizer").config.require_fit(recipe.hardware)  # type: ignore[attr-defined]
    recipe = load_recipe("ude-tiny", [*sets, "tokenizer.net.quantizer=gradient"])
    recipe.stage("tokenizer").config.require_fit(recipe.hardware)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("gpt.net.block_size=4", "block_size 4 holds no motion.* take 6"),
        ("hardware.accelerator=gpu", "no GPU is here; set hardware.devices"),
    ],
)
def test_a_dry_run_refuses_what_cannot_run(override: str, says: str, tmp_path: Path) -> None:
    if "gpu" in override and torch.cuda.is_available():
        pytest.skip("there is a GPU here")
    console = Console(record=True, width=500)
    with pytest.raises(UserError, match=says):
        run_recipe("humantomato-tiny", tmp_path, overrides=[override], dry_run=True, console=console)


def test_a_stage_that_cannot_stand_in_a_role(tmp_path: Path) -> None:
    """By kind (`stats`) or by what it gives (`tokenizer`); what would fit is named."""
    head = "extends: humantomato-tiny\nname: x\n"
    wrong = write(tmp_path, head + "stages: {gpt: {inputs: {tokenizer: tma}}}")
    with pytest.raises(UserError, match=r"'tma' of kind tma, which is no tokenizer; choose .*face_tokenizer"):
        load_recipe(wrong)
    wrong = write(tmp_path, head + "stages: {tma: {inputs: {stats: data}}}")
    with pytest.raises(
        UserError, match=r"'data' of kind synth, which is no stats; choose stats in stages\.tma"
    ):
        load_recipe(wrong)
    fits = write(tmp_path, head + "stages: {face_gpt: {inputs: {start: gpt}}}")
    with pytest.raises(UserError, match="starts from 'gpt', which differs in"):
        load_recipe(fits)


def test_windows_longer_than_the_block_are_refused_before_training(tmp_path: Path) -> None:
    console = Console(quiet=True)
    with pytest.raises(UserError, match=r"block_size 48 holds 47 groups .* max_frames to 188"):
        run_recipe("ude-tiny", tmp_path, overrides=["utt.max_frames=800"], dry_run=True, console=console)


def test_shards_that_are_not_there_or_of_another_layout(tmp_path: Path) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_text("name: x\nstages: {data: {kind: shards, path: shards}, stats: {kind: stats}}")
    missing = [f"data.path={tmp_path / 'nowhere'}"]
    with pytest.raises(UserError, match="nowhere: no such folder; set the path of the data stage"):
        run_recipe(path, tmp_path / "run", overrides=missing, dry_run=True, console=Console(quiet=True))
    synthesize(SynthConfig(clips=4), tmp_path / "shards", workers=1)
    other = [f"data.path={tmp_path / 'shards'}", "data.layout=body133"]
    with pytest.raises(UserError, match="layout wholebody363, but the recipe wants body133"):
        run_recipe(path, tmp_path / "run", overrides=other, dry_run=True, console=Console(quiet=True))


LISTED = """
name: two-faces
stages:
  data: {kind: synth, clips: 8}
  stats: {kind: stats}
  text: {kind: text}
  face_vae: {kind: tma, part: face, net: {frame_stride: 1}, loss: {contrastive: 0}}
  diffusion: {kind: diffusion}
  tma: {kind: tma}
  latents: {kind: aligned_text}
  generate: {kind: generate, inputs: {generators: [face_vae, diffusion]}}
"""


def test_a_stage_of_the_base_can_be_left_out(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(LISTED)
    child = (
        "extends: base\nname: child\nstages: {face_vae: null, generate: {inputs: {generators: [diffusion]}}}"
    )
    names = [stage.name for stage in load_recipe(write(tmp_path, child)).stages]
    assert names == ["data", "stats", "text", "diffusion", "tma", "latents", "generate"]
    sets = ["face_vae=null", "generate.inputs.generators=[diffusion]"]
    assert [stage.name for stage in load_recipe(tmp_path / "base.yaml", sets).stages] == names


@pytest.mark.parametrize(
    ("child", "says"),
    [
        (
            "{face_vae: null}",
            r"generate.inputs.generators: 'face_vae' is no stage that gives a generator, as "
            r"stages.face_vae: null in .*recipe.yaml leaves it out; valid names: diffusion",
        ),
        (
            "{tma: null}",
            r"stage 'latents' needs a stage 'tma' \(role 'tma'\), which stages.tma: null in .* leaves",
        ),
        ("{face_vea: null}", "there is no such stage to remove; did you mean 'face_vae'"),
    ],
)
def test_what_names_a_stage_that_is_left_out(child: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(LISTED)
    with pytest.raises(UserError, match=says):
        load_recipe(write(tmp_path, f"extends: base\nname: child\nstages: {child}"))


@pytest.mark.parametrize(
    ("sets", "says"),
    [
        (["tma=null"], r"needs a stage 'tma' \(role 'tma'\), which --set tma=null leaves out"),
        (["face_vea=null"], "--set face_vea=null: no stage 'face_vea'; did you mean 'face_vae'"),
        (
            ["stages.tmaa=null"],
            "--set stages.tmaa=null: there is no such stage to remove; did you mean 'tma'",
        ),
        (["diffusion=null", "diffusion.net.dim=8"], "no stage 'diffusion'; --set diffusion=null"),
        (["sead=3"], "no stage 'sead'; did you mean 'seed'"),
        (["diffusion.inputs.text=txt"], "needs a stage 'txt' .*; did you mean 'text'"),
        (["generate.inputs.generators=[difusion]"], "'difusion' is no stage .*; did you mean 'diffusion'"),
    ],
)
def test_names_on_the_command_line_that_are_no_stage(sets: list[str], says: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=says):
        load_recipe(write(tmp_path, LISTED), sets)
