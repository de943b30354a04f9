"""What a recipe would take: the paper's counts, and memory that follows the batch."""

from __future__ import annotations

import json
import re
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import write_text
from motionloom.datasets.motion.layout import MotionLayout
from motionloom.models.tokenizer.module import TokenizerModule
from motionloom.models.tokenizer.single import VqConfig
from motionloom.models.training.stage_module import OptimConfig
from motionloom.pipeline.contract.showing import ModelCard
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.cluster.launch import launch_recipe
from motionloom.pipeline.runs.dry_run import Sizes, estimate, estimate_table, training_times
from motionloom.pipeline.runs.plan import Selection, doubts, make_plan
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.store.data import Data
from motionloom.pipeline.training.memory import _saved_bytes
from motionloom.pipeline.training.trained_stage import TrainedStage

PAPER = """
name: paper-sizes
stages:
  data: {kind: synth, layout: wholebody363}
  stats: {kind: stats}
  text: {kind: text}
  tokenizer: {kind: h2vq, train: {batch_size: 64}}
  vanilla: {kind: vq, net: {num_codes: 1024, reset_below: 0.2}, train: {batch_size: 64}}
  tma: {kind: tma, train: {batch_size: 64}}
  tokens: {kind: tokens}
  gpt: {kind: gpt, loss: {align_weight: 0.0}, train: {batch_size: 64}}
"""


@pytest.fixture
def paper(tmp_path: Path) -> Path:
    path = tmp_path / "paper.yaml"
    path.write_text(PAPER)
    return path


def _numbers(text: str) -> list[int]:
    return [int(number) for number in re.findall(r"\d+", text)]


def test_paper_counts(paper: Path) -> None:
    rows = estimate(load_recipe(paper))
    assert list(rows) == ["tokenizer", "vanilla", "tma", "gpt"]
    assert _numbers(rows["gpt"].note) == [98, 49, 2, 149, 196]
    assert rows["gpt"].parameters == pytest.approx(229e6, rel=0.01)
    # 7.5 groups a second: (2 + 1) x 9 bits against 1 x 10 bits.
    assert _numbers(rows["tokenizer"].note) == [2, 1, 4, 202]
    assert _numbers(rows["vanilla"].note) == [1, 4, 75]
    assert {row.local_batch for row in rows.values()} == {64}
    console = Console(record=True, width=200)
    console.print(estimate_table(rows, {}))
    text = console.export_text()
    assert "GiB" in text and "300,000" in text


def test_memory_follows_batch_and_checkpointing(paper: Path) -> None:
    def card(*overrides: str) -> ModelCard:
        return estimate(load_recipe(paper, overrides), {"gpt"})["gpt"]

    def memory(*overrides: str) -> int:
        return card(*overrides).memory_bytes

    first = card()
    whole, weights = first.memory_bytes, 16 * first.parameters
    half = memory("gpt.train.batch_size=32")
    assert whole - weights == pytest.approx(2 * (half - weights), rel=0.02)
    assert memory("gpt.train.checkpoint_activations=true") - weights < 0.2 * (whole - weights)
    assert memory("gpt.train.accumulate=2") == half


SMALL = """
name: small
hardware: {accelerator: cpu, devices: 1}
stages:
  data: {kind: synth, layout: body133, clips: 10}
  stats: {kind: stats}
  tokenizer:
    {kind: vq, net: {width: 16, depth: 1, code_dim: 8, num_codes: 16}, train: {steps: 7, batch_size: 8}}
"""


def test_time_is_known_from_the_run_itself(tmp_path: Path) -> None:
    """And a time limit that cannot be enough is refused."""
    path, flight = tmp_path / "small.yaml", tmp_path / "run/stages/tokenizer/flight/rank_0.jsonl"
    path.write_text(SMALL)
    recipe, run = load_recipe(path), tmp_path / "run"
    plan, card = make_plan(recipe, run), estimate(recipe)["tokenizer"]
    assert training_times(run, plan) == {} and card.steps == 7
    # Weights and two moments in float32, of the two checkpoints that are kept.
    assert card.checkpoint_bytes >= 2 * 3 * 4 * card.parameters
    write_text(flight, "".join(json.dumps({"step": k, "step_seconds": 3600.0}) + "\n" for k in range(3)))
    assert training_times(run, plan) == {"tokenizer": 7 * 3600.0}
    quiet = Console(quiet=True)
    for minutes, requeues in ((300, 1), (300, 0)):
        words = [f"time_minutes={minutes}", f"requeues={requeues}"]
        with pytest.raises(UserError, match="takes about 7 h") if not requeues else nullcontext():
            launch_recipe(
                path, out=tmp_path / "run", gpus_per_node=0, options=words, dry_run=True, console=quiet
            )


def test_what_will_hardly_do_what_is_meant_is_said(tmp_path: Path) -> None:
    """Clips are known once there are some: of 10, 6 are for training."""
    path, run = tmp_path / "small.yaml", tmp_path / "run"
    path.write_text(SMALL)
    sets = ["tokenizer.optim.warmup_steps=8", "tokenizer.train.batch_size=16"]
    recipe = load_recipe(path, sets)
    (doubt,) = doubts(recipe, run, recipe.stages)
    assert doubt.startswith("tokenizer: optim.warmup_steps 8 ") and " 7 steps" in doubt
    for name, stage, key in (
        ("humantomato-tiny", "gpt", "loss.align_from"),
        ("ude-tiny", "utt", "loss.adversarial_start"),
    ):
        for step in (59, 60):
            short = load_recipe(name, [f"{stage}.{key}={step}", f"{stage}.train.steps=60"])
            found = [one for one in doubts(short, run, short.stages) if f"{stage}: {key} 60 " in one]
            assert len(found) == step - 59
    run_recipe(path, run, select=Selection(until="data"), console=Console(quiet=True))
    clips = Data(run / "stages/data").clips("train")
    said = Console(record=True, width=300)
    run_recipe(path, run, overrides=sets, dry_run=True, console=said)
    text = said.export_text()
    assert doubt in text and f"data has {clips} training clips and a batch 16" in text and clips < 16
    said = Console(record=True, width=300)
    run_recipe(path, tmp_path / "whole", overrides=sets, console=said)
    text = said.export_text()
    assert [text.count(words) for words in (doubt, f"{clips} training clips")] == [1, 1]


def test_sizes_are_remembered_until_something_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path, asked = tmp_path / "small.yaml", list[int]()
    path.write_text(SMALL)
    measure = TrainedStage.estimate

    def counted(self: Any, config: Any, *rest: Any) -> ModelCard:
        asked.append(config.train.batch_size)
        return measure(self, config, *rest)

    monkeypatch.setattr(TrainedStage, "estimate", counted)
    recipe = load_recipe(path)
    plan = make_plan(recipe, tmp_path / "run")
    assert estimate(recipe, plan=plan, measure=False) == {} and asked == []
    for sets in ([], [], ["tokenizer.train.batch_size=4"], ["tokenizer.train.keep_every=2"], []):
        recipe = load_recipe(path, sets)
        card = estimate(recipe, plan=make_plan(recipe, tmp_path / "run"))["tokenizer"]
        assert card.batch == (4 if "batch" in str(sets) else 8)
    assert asked == [8, 4, 8]
    Sizes.place().write_text("{")
    card = estimate(recipe, plan=plan)["tokenizer"]
    assert asked == [8, 4, 8, 8] and estimate(recipe, plan=plan, measure=False) == {"tokenizer": card}


def test_saved_bytes_of_a_known_network() -> None:
    """Against the real thing: sizes of the storages that real tensors keep."""
    config = VqConfig(width=16, depth=1, code_dim=16, num_codes=32)
    sizes = []
    for fake in (True, False):
        mode = torch._subclasses.fake_tensor.FakeTensorMode(allow_non_fake_inputs=True)
        with mode if fake else torch.enable_grad():
            net = config.build(MotionLayout.named("body133"))
            module = TokenizerModule(net, OptimConfig(), seed=0, max_steps=1)
            batch = {"motion": torch.zeros(4, 16, 133), "length": torch.full((4,), 16)}
            sizes.append(_saved_bytes(module, batch, half=False))
    assert sizes[0] == pytest.approx(sizes[1], rel=0.1)


@pytest.mark.parametrize(
    ("recipe", "sets", "stage", "says"),
    [
        ("humantomato-tiny", ["data.layout=body133"], "tokenizer", "layout body133 .* hand"),
        ("bvh-body", ["data.layout=body133", "tma.net.finger_gain=4"], "tma", "finger_gain .*body133"),
        ("ude-tiny", ["utt.max_frames=800"], "utt", "block_size 48 holds 47 .* max_frames to 188"),
        ("humantomato-tiny", ["gpt.net.block_size=4"], "gpt", "block_size holds no motion.*raise it"),
    ],
)
def test_what_does_not_fit_is_told_with_the_stage(
    recipe: str, sets: list[str], stage: str, says: str
) -> None:
    with pytest.raises(UserError, match=f"stage {stage}: .*{says}"):
        estimate(load_recipe(recipe, sets), {stage})


def test_a_trainer_has_the_loss_that_its_recipe_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not its default: of every kind that has one."""
    real, seen = TrainedStage.module, set[str]()

    def module(self: Any, config: Any, *rest: Any, **named: Any) -> Any:
        made = real(self, config, *rest, **named)
        if "loss" in type(config).model_fields:
            assert made.loss_config is config.loss, self.name
            seen.add(self.name)
        return made

    monkeypatch.setattr(TrainedStage, "module", module)
    estimate(load_recipe("baselines-tiny"), {"tma", "gpt", "evaluator", "mld_vae"})
    estimate(load_recipe("baselines-tiny-ude"), {"utt", "motionclip", "captioner", "seq2seq", "actor_critic"})
    assert seen == {"tma", "gpt", "evaluator", "motion_vae", "utt", "motionclip", "captioner", "seq2seq"}
