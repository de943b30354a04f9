"""`defaults:` of a recipe, what recipes extend, and stages taken out: plain data before any stage runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from motionloom.datasets.schema import UserError
from motionloom.pipeline.runs.layers import merge
from motionloom.pipeline.runs.recipe import Recipe, load_recipe

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


def recipe(folder: Path, text: str, *overrides: str, name: str = "recipe") -> Recipe:
    path = folder / f"{name}.yaml"
    path.write_text(text)
    return load_recipe(path, overrides)


def config(found: Recipe, stage: str) -> Any:
    return found.stage(stage).config


def test_a_stage_stands_on_its_kind_and_its_kind_on_trained(tmp_path: Path) -> None:
    found = recipe(tmp_path, BASE)
    tokenizer, other = config(found, "tokenizer"), config(found, "other")
    assert (tokenizer.net.width, tokenizer.net.num_codes) == (24, 16)
    assert (tokenizer.train.steps, tokenizer.train.batch_size) == (60, 64)
    assert tokenizer.train.precision == other.train.precision == "bf16-mixed"
    assert (tokenizer.optim.lr, tokenizer.optim.warmup_steps) == (3e-4, 7)
    assert (other.train.steps, other.train.batch_size, other.net.width) == (50, 256, 512)
    assert config(found, "data").clips == 9


def test_the_resolved_recipe_has_no_defaults_and_reads_the_same(tmp_path: Path) -> None:
    found = recipe(tmp_path, BASE)
    assert "defaults" not in found.to_yaml()
    assert recipe(tmp_path, found.to_yaml(), name="again") == found


def test_it_equals_the_recipe_that_repeats_itself(tmp_path: Path) -> None:
    written = """
name: base
stages:
  data: {kind: synth, clips: 9}
  stats: {kind: stats}
  tokenizer:
    kind: vq
    net: {num_codes: 16, width: 24}
    optim: {lr: 3.0e-4, warmup_steps: 7}
    train: {steps: 60, precision: bf16-mixed, batch_size: 64}
  other: {kind: rvq, optim: {lr: 3.0e-4, warmup_steps: 7}, train: {steps: 50, precision: bf16-mixed}}
"""
    assert recipe(tmp_path, BASE).to_yaml() == recipe(tmp_path, written).to_yaml()


def test_set_wins_and_may_change_defaults(tmp_path: Path) -> None:
    found = recipe(tmp_path, BASE, "tokenizer.net.width=40", "defaults.trained.optim.lr=1e-3")
    assert config(found, "tokenizer").net.width == 40
    assert config(found, "tokenizer").optim.lr == config(found, "other").optim.lr == 1e-3


def test_what_extends_brings_its_own_defaults(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(BASE)
    child = """
extends: base
name: child
defaults: {trained: {optim: {lr: 5.0e-4}, train: {steps: 70}}, fsq: {net: {width: 8}}}
stages: {more: {kind: fsq}, other: {kind: separate}}
"""
    found = recipe(tmp_path, child)
    assert (config(found, "tokenizer").train.steps, config(found, "other").train.steps) == (60, 70)
    assert (config(found, "more").net.width, config(found, "more").optim.lr) == (8, 5e-4)
    assert config(found, "more").optim.warmup_steps == 7, "the base's, which the child does not name"


def test_defaults_of_a_base_may_concern_a_stage_that_was_replaced(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(BASE)
    found = recipe(tmp_path, "extends: base\nname: child\nstages: {tokenizer: {kind: fsq}}")
    assert config(found, "tokenizer").net.width == 512
    assert recipe(tmp_path, BASE, "tokenizer={kind: fsq}").stage("tokenizer").kind.name == "fsq"


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
def test_wrong_defaults_are_refused_by_name(defaults: str, says: str, tmp_path: Path) -> None:
    text = BASE[: BASE.index("defaults:")] + f"defaults: {defaults}\n" + BASE[BASE.index("stages:") :]
    with pytest.raises(UserError, match=says):
        recipe(tmp_path, text)


def test_trained_without_a_stage_that_trains_is_refused(tmp_path: Path) -> None:
    text = "name: x\ndefaults: {trained: {train: {steps: 3}}}\nstages: {data: {kind: synth}}"
    with pytest.raises(UserError, match=r"defaults\.trained concerns no stage: there is none that trains"):
        recipe(tmp_path, text)


def test_half_of_a_default_may_need_the_stage(tmp_path: Path) -> None:
    """7 heads do not divide the usual width but the stage's own; the source of `bvh` is its own."""
    text = """
name: x
defaults: {dmd: {net: {heads: 7}}, bvh: {fps: 20}}
stages:
  data: {kind: bvh, source: mocap, joint_map: map.json, licence: unknown}
  stats: {kind: stats}
  tokenizer: {kind: vq}
  dmd: {kind: dmd, net: {dim: 70}}
"""
    assert config(recipe(tmp_path, text), "dmd").net.heads == 7


def test_null_takes_a_stage_out_of_the_base(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(BASE)
    found = recipe(tmp_path, "extends: base\nname: child\nstages: {other: null}")
    assert [stage.name for stage in found.stages] == ["data", "stats", "tokenizer"]
    with pytest.raises(UserError, match=r"stages\.othr is null .* did you mean 'other'"):
        recipe(tmp_path, "extends: base\nname: child\nstages: {othr: null}")
    with pytest.raises(UserError, match=r"stages\.other"):
        recipe(tmp_path, BASE.replace("{kind: rvq}", "null"))


def test_a_kind_within_a_stage_replaces_nothing(tmp_path: Path) -> None:
    """Of `utt`, `net.kind` is a choice among fields that are the same for both."""
    (tmp_path / "base.yaml").write_text(
        "name: base\nstages:\n  data: {kind: synth}\n  stats: {kind: stats}\n  text: {kind: text}\n"
        "  audio: {kind: audio}\n  tokenizer: {kind: mq}\n  utt: {kind: utt, net: {layers: 2}}\n"
    )
    found = recipe(tmp_path, "extends: base\nname: child\nstages: {utt: {net: {kind: gru}}}")
    assert (config(found, "utt").net.kind, config(found, "utt").net.layers) == ("gru", 2)


def test_extends_takes_a_path_beside_the_file_and_a_folder_of_shipped_ones(tmp_path: Path) -> None:
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "base.yaml").write_text(BASE)
    assert len(recipe(tmp_path, "extends: below/base.yaml\nname: child").stages) == 4
    by_folder = recipe(tmp_path, "extends: humantomato/tiny\nname: child")
    assert by_folder.stages == load_recipe("humantomato-tiny").stages


def test_merging_alters_neither_side() -> None:
    base, change = {"a": {"b": 1, "c": [1]}, "d": 2}, {"a": {"c": [2]}, "d": {"e": 3}}
    assert merge(base, change) == {"a": {"b": 1, "c": [2]}, "d": {"e": 3}}
    assert base == {"a": {"b": 1, "c": [1]}, "d": 2} and change == {"a": {"c": [2]}, "d": {"e": 3}}
