"""Recipes: read, extended, overridden, with defaults of kinds; refused by the key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.layers import shipped_recipes
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.store.yaml import read_yaml

QUIET = Console(quiet=True)


@pytest.fixture
def load(tmp_path: Path) -> Any:
    """`load(text, *sets, base=...)`: the recipe of a text; with `base` it may extend that text as `base`."""

    def go(text: str, *sets: str, base: str | None = None) -> Recipe:
        path = tmp_path / "recipe.yaml"
        path.write_text(text)
        if base is not None:
            (tmp_path / "base.yaml").write_text(base)
        return load_recipe(path, sets)

    return go


def names(recipe: Recipe) -> list[str]:
    return [stage.name for stage in recipe.stages]


def config(recipe: Recipe, stage: str) -> Any:
    return recipe.stage(stage).config


# Those that start from a model of the package need its weights: test_finetune.py.
@pytest.mark.parametrize("name", sorted({*shipped_recipes()} - {"finetune"}))
def test_shipped_recipes_load_and_reload(name: str, load: Any) -> None:
    recipe, path = load_recipe(name), shipped_recipes()[name]
    assert recipe.description and load(recipe.to_yaml()) == recipe
    assert read_yaml(path)["name"] == name == f"{path.parent.name}-{path.stem}"
    assert load_recipe(f"{path.parent.name}/{path.stem}").name == name


def test_ablations_of_ude_change_what_they_are_named_for() -> None:
    """Tables 3 to 5; beside what is named, the recipes of a size are equal."""
    for size in ("tiny", "paper"):
        base, gru = load_recipe(f"ude-{size}"), load_recipe(f"ude-{size}-gru")
        assert config(base, "ude").inject_z and "dmd" in base.stage("ude").inputs
        for name in ("no-z", "no-z-vq-decoder", "vq-decoder"):
            recipe = load_recipe(f"ude-{size}-{name}")
            assert config(recipe, "ude").inject_z == (name == "vq-decoder")
            assert ("dmd" in recipe.stage("ude").inputs) == (name == "no-z")
            trained = {stage.name: stage for stage in recipe.stages if stage.kind.trains}
            assert all(stage == base.stage(name) for name, stage in trained.items())
        wanted = config(base, "utt").net.model_copy(update={"kind": "gru"})
        assert config(gru, "utt").net == wanted


TINY = "extends: humantomato-tiny\nname: x\n"
CHILD = "extends: base\nname: child\nstages: "
LISTED = """
name: two-faces
stages:
  data: {kind: synth, clips: 8}
  stats: {kind: stats}
  text: {kind: text}
  face_vae: {kind: tma, part: face, net: {frame_stride: 1}, loss: {contrastive: 0}}
  diffusion: {kind: mdm, part: face}
  tma: {kind: tma}
  generate: {kind: generate, inputs: {generators: [face_vae, diffusion]}}
"""


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("tma.optim.lrr=1", "did you mean 'lr'"),
        ("tmaa.optim.lr=1", "did you mean 'tma'"),
        ("tma.optim.lr", "stage.field=value"),
        ("tma.optim.lr=fast", "optim.lr"),
        ("tma.train.steps=0", "train.steps"),
        ("hardware.device=2", "did you mean 'hardware.devices'|did you mean 'devices'"),
        ("tma={train: {stepz: 3}}", "stages.tma: unknown key 'train.stepz'; did you mean 'steps'"),
        ("tma.kind=tmaa", "is no stage kind; did you mean 'tma'"),
        ("gpt.net.heads=7", "with --set: stages.gpt: .*dim 160 must be a multiple of heads 7"),
        ("tma.net.heads=3", "latent 128 must be a multiple of heads 3"),
        ("tokenizer.inputs.data=null", "stage 'tokenizer' needs a stage 'None'"),
        ("lr=1", r"for which training: \w+\.optim\.lr or .*; or defaults\.trained\.optim\.lr"),
        ("train.steps=3", r"for which training: \w+\.train\.steps"),
        ("sead=3", "no stage 'sead'; did you mean 'seed'"),
        ("stats=null", r"needs a stage 'stats' \(role 'stats'\)"),
        ("face_tokenizr=null", "--set face_tokenizr=null: no stage .*; did you mean 'face_tokenizer'"),
        ("stages.tmaa=null", "--set stages.tmaa=null: there is no such stage to remove; did you mean 'tma'"),
        ("tma.inputs.text=txt", "needs a stage 'txt' .*; did you mean 'text'"),
        ("generate.inputs.generators=[gptt]", "'gptt' is no stage .*; did you mean 'gpt'"),
    ],
)
def test_wrong_overrides_name_the_key_and_the_fix(override: str, says: str) -> None:
    with pytest.raises(UserError, match=says):
        load_recipe("humantomato-tiny", [override])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name: x\nstages: {stats: {kind: stats}}", "needs a stage 'data'"),
        ("name: x\nstages: {data: {kind: synth}, s: {kind: stats, inputs: {dat: data}}}", "role 'dat'"),
        ("name: x\nstage: {}", "unknown key 'stage'; did you mean 'stages'"),
        ("name: ../x\nstages: {data: {kind: synth}}", "name"),
        ("name: /tmp/x\nstages: {data: {kind: synth}}", "name"),
        ("name: x\nstages: {../../victim: {kind: stats}}", "stage name '../../victim'"),
        ("name: x\nstages: {/tmp/victim: {kind: stats}}", "stage name '/tmp/victim'"),
        ("name: x\nstages: {data: {kind: os.system}}", "'os.system' is no stage kind"),
        ("name: x\nstages: {data: {kind: [synth]}}", "'synth'.' is no stage kind"),
        (TINY + "stages: {tokenizer: {optim: {grad_clip: .inf}}}", "'optim.grad_clip' = inf: .*finite"),
        (TINY + "stages: {tokenizer: {optim: {betas: [0.9, 1.0]}}}", "'optim.betas.1' = 1.0: .*less than 1"),
        ("name: x\nstages: {data: {kind: synth, clips: 1000000000000}}", "'clips' = 1000000000000"),
        ("name: x\nhardware: {nodes: 9999999999}\nstages: {data: {kind: synth}}", "hardware.nodes = 99999"),
        (TINY + "stages: {gpt: {train: {steps: 9999999999}}}", "train.steps = 9999999999: at most"),
        (TINY + f"stages: {{gpt: {{{', '.join(f'k{k}: 1' for k in range(99))}}}}}", "'k9'.*\n.*89 more$"),
        ("name: x\nstages: {data: {kind: synth, target: os.system}}", "unknown key 'target'"),
        ("[1, 2]", "mapping"),
        ("a: [", "not valid YAML"),
        ("name: x\nstages: {}\nname: y", "key 'name' is in line 1 already.*line 3"),
        ("name: x\nstages: {data: {kind: synth, clips: 3, clips: 4}}", "key 'clips'"),
        (TINY + "stages: {toknizer: {train: {steps: 3}}}", "did you mean 'tokenizer'"),
        ("extends: recipe\nname: x", "circle"),
        (TINY + "stages: {face_vae: {kind: tma, part: face, net: {frame_stride: 2}}}", "frame_stride .* 1"),
        # By kind or by what it gives; what would fit is named.
        (TINY + "stages: {gpt: {inputs: {tokenizer: tma}}}", "'tma' .* no tokenizer; .*face_tokenizer"),
        (TINY + "stages: {tma: {inputs: {stats: data}}}", r"'data' .* no stats; .*stats in stages\.tma"),
        (TINY + "stages: {face_gpt: {inputs: {start: gpt}}}", "starts from 'gpt', which differs in"),
        (CHILD + "{face_vae: null}", r"inputs.generators: 'face_vae' .* diffusion"),
        (CHILD + "{text: null}", r"'face_vae' needs a stage 'text'"),
        (CHILD + "{face_vea: null}", "did you mean 'face_vae'"),
        (LISTED.replace("{kind: mdm, part: face}", "null"), r"stages\.diffusion"),
    ],
)
def test_wrong_recipes_are_refused(text: str, says: str, load: Any) -> None:
    with pytest.raises(UserError, match=says):
        load(text, base=LISTED)


def test_a_stage_of_the_base_can_be_left_out(load: Any) -> None:
    child = CHILD + "{face_vae: null, generate: {inputs: {generators: [diffusion]}}}"
    left = ["data", "stats", "text", "diffusion", "tma", "generate"]
    assert names(load(child, base=LISTED)) == left
    assert names(load(LISTED, "face_vae=null", "generate.inputs.generators=[diffusion]")) == left
    with pytest.raises(UserError, match="no stage 'diffusion'"):
        load(LISTED, "diffusion=null", "diffusion.net.dim=8")


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


def test_a_tma_on_captions_of_another_encoder_is_refused(load: Any) -> None:
    with pytest.raises(UserError, match=r"'gpt' .*'clip' .*'tma' .*'text'"):
        load(CAPTIONED)
    for change in (("inputs: {text: clip}", "inputs: {text: clip, tma: null}"), ("some-clip", "minilm")):
        load(CAPTIONED.replace(*change))


@pytest.mark.parametrize(
    ("recipe", "override", "says"),
    [
        ("humantomato-tiny", "tokenizer.net.reset_below=1.0", r"stage tokenizer: .*reset_below to 0\.\d+"),
        ("humantomato-tiny", "tokenizer.net.num_codes=8192", r"stage tokenizer: .*reset_below to 0\.\d+"),
        ("ude-tiny", "tokenizer.net.reset_below=1.0", r"256 codes .*256 vectors .*to 0\.25 or less"),
        ("baselines-tiny-ude", "dance_vq.net.reset_below=2.0", r"stage dance_vq: .*to 0\.5 or less"),
        ("humantomato-tiny", "hardware.accelerator=gpu", "no GPU is here; set hardware.devices"),
    ],
)
def test_what_cannot_run_is_refused_before_anything_runs(
    recipe: str, override: str, says: str, tmp_path: Path
) -> None:
    if "gpu" in override and torch.cuda.is_available():
        pytest.skip("there is a GPU here")
    stage = override.split(".")[0]
    # The networks of later stages take long to build.
    select = Selection(until=None if stage == "hardware" else stage)
    for dry_run in (True, False) if "1.0" in override else (True,):
        with pytest.raises(UserError, match=says):
            run_recipe(recipe, tmp_path, overrides=[override], dry_run=dry_run, select=select, console=QUIET)
    assert not list(tmp_path.rglob("artifact.json"))


def test_a_codebook_that_a_gradient_learns_is_never_reset() -> None:
    recipe = load_recipe("ude-tiny", ["tokenizer.net.reset_below=1.0", "tokenizer.net.quantizer=gradient"])
    config(recipe, "tokenizer").require_fit(recipe.hardware)


def test_shards_that_are_not_there_or_of_another_layout(tmp_path: Path) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_text("name: x\nstages: {data: {kind: shards, path: shards}, stats: {kind: stats}}")
    synthesize(SynthConfig(clips=4), tmp_path / "shards", workers=1)
    for sets, says in (
        ([f"data.path={tmp_path / 'nowhere'}"], "nowhere: "),
        ([f"data.path={tmp_path / 'shards'}", "data.layout=body133"], "wholebody363, .*body133"),
    ):
        with pytest.raises(UserError, match=says):
            run_recipe(path, tmp_path / "run", overrides=sets, dry_run=True, console=QUIET)


BASE = """
name: base
defaults:
  trained: {optim: {lr: 3.0e-4, warmup_steps: 7}, train: {steps: 50, precision: bf16-mixed}}
  vq: {net: {width: 24, num_codes: 32}, train: {batch_size: 64}}
  synth: {clips: 9}
stages:
  data: {kind: synth}
  stats: {kind: stats}
  tokenizer: {kind: vq, net: {num_codes: 16}, train: {steps: 60}}
  other: {kind: rvq}
"""


def test_a_stage_stands_on_its_kind_and_its_kind_on_trained(load: Any) -> None:
    found = load(BASE)
    tokenizer, other = config(found, "tokenizer"), config(found, "other")
    assert (tokenizer.net.width, tokenizer.net.num_codes) == (24, 16)
    assert (tokenizer.train.steps, tokenizer.train.batch_size) == (60, 64)
    assert tokenizer.train.precision == other.train.precision == "bf16-mixed"
    assert (tokenizer.optim.lr, tokenizer.optim.warmup_steps) == (3e-4, 7)
    assert (other.train.steps, other.train.batch_size, other.net.width) == (50, 256, 512)
    assert config(found, "data").clips == 9
    assert "defaults" not in found.to_yaml() and load(found.to_yaml()) == found
    found = load(BASE, "tokenizer.net.width=40", "defaults.trained.optim.lr=1e-3")
    assert config(found, "tokenizer").net.width == 40
    assert config(found, "tokenizer").optim.lr == config(found, "other").optim.lr == 1e-3
    # Half of a default may need the stage: 7 heads do not divide the usual width, but the stage's own.
    seven = (
        BASE.replace("  synth:", "  dmd: {net: {heads: 7}}\n  synth:") + "  dmd: {kind: dmd, net: {dim: 70}}"
    )
    assert config(load(seven), "dmd").net.heads == 7


def test_what_extends_brings_its_own_defaults(load: Any, tmp_path: Path) -> None:
    child = """
extends: base
name: child
defaults: {trained: {optim: {lr: 5.0e-4}, train: {steps: 70}}, fsq: {net: {width: 8}}}
stages: {more: {kind: fsq}, other: {kind: separate}, data: {clips: 11}}
"""
    found = load(child, base=BASE)
    assert found.name == "child" and config(found, "data").clips == 11
    assert (config(found, "tokenizer").train.steps, config(found, "other").train.steps) == (60, 70)
    assert (config(found, "more").net.width, config(found, "more").optim.lr) == (8, 5e-4)
    assert config(found, "more").optim.warmup_steps == 7, "the base's, which the child does not name"
    # Those of a base may concern a stage that was replaced.
    assert config(load(CHILD + "{tokenizer: {kind: fsq}}"), "tokenizer").net.width == 512
    assert load(BASE, "tokenizer={kind: fsq}").stage("tokenizer").kind.name == "fsq"
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "base.yaml").write_text(BASE)
    assert len(load("extends: below/base.yaml\nname: child").stages) == 4
    assert load("extends: humantomato/tiny\nname: child").stages == load_recipe("humantomato-tiny").stages


@pytest.mark.parametrize(
    ("defaults", "says"),
    [
        ("{trainde: {optim: {}}}", "defaults.trainde: no stage kind 'trainde'; did you mean 'trained'"),
        ("{trained: {trian: {steps: 3}}}", "defaults.trained: unknown key 'trian'; did you mean 'train'"),
        ("{trained: {net: {width: 3}}}", "defaults.trained: unknown key 'net'"),
        ("{vq: {net: {widht: 3}}}", "defaults.vq: unknown key 'net.widht'; did you mean 'width'"),
        ("{vq: {train: {steps: many}}}", "defaults.vq: key 'train.steps' = 'many'"),
        ("{vq: {kind: rvq}}", "defaults.vq: unknown key 'kind'"),
        ("{fsq: {net: {width: 3}}}", "defaults.fsq concerns no stage: there is none of kind fsq"),
        ("{vq: 3}", "defaults.vq"),
        ("[vq]", "defaults"),
    ],
)
def test_wrong_defaults_are_refused_by_name(defaults: str, says: str, load: Any) -> None:
    text = BASE[: BASE.index("defaults:")] + f"defaults: {defaults}\n" + BASE[BASE.index("stages:") :]
    with pytest.raises(UserError, match=says):
        load(text)
    with pytest.raises(UserError, match=r"defaults\.trained concerns no stage"):
        load("name: x\ndefaults: {trained: {train: {steps: 3}}}\nstages: {data: {kind: synth}}")


def test_a_part_of_a_group_keeps_the_groups_own_defaults() -> None:
    """UDE's schedule is linear (3.4); ude-tiny gives only what it predicts."""
    dmd = load_recipe("ude-tiny").stage("dmd").config
    assert (dmd.net.schedule.betas, dmd.net.schedule.predicts) == ("linear", "sample")
    generate = load_recipe("ude-tiny").stage("generate").config
    assert generate.sampling.sampler is None and generate.sampling.model_fields_set == {
        "temperature",
        "top_p",
    }
