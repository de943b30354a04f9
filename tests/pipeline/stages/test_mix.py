"""Data stages of one recipe as one: drawn by weight, told apart by nothing, and moved with their run."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Manifest
from motionloom.datasets.loading.plan import BatchPlan
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.datasets.synth.generate import SynthConfig, make_sample, synthesize
from motionloom.pipeline.contract.lookup import preview_of
from motionloom.pipeline.contract.stage import StageCache, StageContext, stage_kind
from motionloom.pipeline.launch.hardware import Hardware
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.recipe import load_recipe
from motionloom.pipeline.stages.data.data import SynthStageConfig, run_synth
from motionloom.pipeline.store.data import Data

RECIPE = """
name: mixed
hardware: {accelerator: cpu, convert_workers: 1}
defaults: {synth: {layout: body133, val_fraction: 0.0, test_fraction: 0.25}}
stages:
  texts: {kind: synth, clips: 12, seed: 3, actions: [walk, wave]}
  dances: {kind: synth, clips: 8, seed: 4, actions: [dance], dances: {songs: 4, song_seconds: 8.0}}
  data: {kind: mix, weights: {dances: 3}}
  stats: {kind: stats}
  audio: {kind: audio}
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "recipe.yaml"
    path.write_text(text)
    return path


def stage(run: Path, name: str) -> Path:
    return run / "stages" / name


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mix")
    return run_recipe(write(folder, RECIPE), folder / "run", console=Console(quiet=True))


def clips(dataset: ClipDataset) -> list[np.ndarray]:
    return [dataset.motion(i) for i in range(len(dataset))]


def test_it_is_the_clips_of_both(run: Path) -> None:
    data = Data(stage(run, "data"))
    apart = [Data(stage(run, name)) for name in ("texts", "dances")]
    assert data.splits == ["train", "test"] and data.layout == apart[0].layout
    for split in data.splits:
        found, wanted = clips(data.split(split)), [m for one in apart for m in clips(one.split(split))]
        assert len(found) == len(wanted)
        assert all(np.array_equal(a, b) for a, b in zip(found, wanted, strict=True))
    assert data.held_out().split == "test"


def test_training_draws_by_weight(run: Path) -> None:
    """A quarter of what an epoch draws is text clips, whatever their number (its places divide by four)."""
    dataset = Data(stage(run, "data")).split("train")
    texts = len(Data(stage(run, "texts")).split("train"))
    sources = dataset.sources()
    assert [source.weight for source in sources] == [1.0, 3.0]
    plan = BatchPlan(len(dataset), 4, sources=sources, seed=0)
    drawn = np.concatenate([plan.batch(step)[1] for step in range(plan.batches_per_epoch)])
    assert texts > len(dataset) / 2 and np.mean(drawn < texts) == 0.25


def test_data_of_another_run(run: Path, tmp_path: Path) -> None:
    """It is named by its path, weighed by the name of both, and found again when both runs are moved."""
    text = f"""
name: more
hardware: {{accelerator: cpu, convert_workers: 1}}
stages:
  own: {{kind: synth, layout: body133, clips: 4, val_fraction: 0.0, test_fraction: 0.0, actions: [walk]}}
  data: {{kind: mix, inputs: {{data: [own, {tmp_path}/run/stages/dances]}}, weights: {{"run:dances": 3}}}}
"""
    shutil.copytree(run, tmp_path / "run")
    made = run_recipe(write(tmp_path, text), tmp_path / "more", console=Console(quiet=True))
    dataset = Data(stage(made, "data")).split("train")
    own, dances = (Data(folder).split("train") for folder in (stage(made, "own"), stage(run, "dances")))
    assert [source.weight for source in dataset.sources()] == [1.0, 3.0]
    wanted = clips(own) + clips(dances)
    assert all(np.array_equal(a, b) for a, b in zip(clips(dataset), wanted, strict=True))
    with pytest.raises(UserError, match=r"weights\.dances .* own, run:dances"):
        load_recipe(tmp_path / "recipe.yaml", ["data.weights={dances: 1}"])
    with pytest.raises(UserError, match="stages/data', a mix itself"):
        load_recipe(tmp_path / "recipe.yaml", [f"data.inputs.data=[own, {tmp_path}/run/stages/data]"])
    (tmp_path / "both").mkdir()
    for name in ("run", "more"):
        (tmp_path / name).rename(tmp_path / "both" / name)
    assert len(Data(stage(tmp_path / "both/more", "data")).split("train")) == len(wanted)


def test_its_layout_is_known_before_it_runs(tmp_path: Path) -> None:
    def layout(*sets: str) -> str:
        recipe = load_recipe(write(tmp_path, RECIPE), sets)
        stages = {stage.name: stage for stage in recipe.stages}
        name: str = preview_of(stages["data"], stages).layout.name
        return name

    assert layout() == "body133"
    with pytest.raises(UserError, match=r"'dances', .*'texts': .*wholebody363"):
        layout("dances.layout=wholebody363", "dances.fps=20")


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("data.weights={dance: 1}", "weights.dance is of no stage that it mixes; these are texts, dances"),
        ("data.weights={dances: 0}", "weights.dances"),
        ("data.inputs.data=[texts, more]", "'more' is no stage that gives a data"),
        ("data.inputs.data=[]", "mixes data stages and the recipe has no other one"),
        ("stages.again={kind: mix, inputs: {data: [data]}}", "'again' mixes 'data', a mix itself"),
    ],
)
def test_wrong_mixes_are_refused(override: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=says):
        # As with any input that several stages may fill, a second mix would be read by the first.
        named = ["data.inputs.data=[texts, dances]"] if "again" in override else []
        load_recipe(write(tmp_path, RECIPE), [*named, override])


def test_layouts_that_differ_only_in_the_shards_are_refused_when_it_runs(tmp_path: Path) -> None:
    for layout, fps in (("body133", 20.0), ("body133", 25.0)):
        config = SynthConfig(clips=2, layout=layout, fps=fps, actions=["wave"])  # type: ignore[arg-type]
        synthesize(config, tmp_path / f"at{fps:g}", progress=False)
    text = f"""
name: rates
hardware: {{accelerator: cpu}}
stages:
  slow: {{kind: shards, path: {tmp_path}/at20, layout: body133}}
  fast: {{kind: shards, path: {tmp_path}/at25, layout: body133}}
  data: {{kind: mix}}
"""
    with pytest.raises(UserError, match=r"'fast', .*'slow': .*body133"):
        run_recipe(write(tmp_path, text), tmp_path / "run", console=Console(quiet=True))


# Seeds: the recipe's where a stage names none, and its own otherwise; 0 is one.

SEEDED = """
name: seeds
seed: 7
stages:
  data: {kind: synth, clips: 12, layout: body133, min_seconds: 2.0, max_seconds: 5.0, seed: 1}
  stats: {kind: stats}
  tokenizer: &small
    kind: mq
    net: {part: all, width: 8, depth: 0, code_dim: 4, num_codes: 8, quantizer: ema}
    train: {steps: 3, batch_size: 8, checkpoint_every: 3, validate_every: 0}
  same: *small
  other: *small
"""


def test_trainings_of_one_recipe_differ_by_their_seed_alone(tmp_path: Path) -> None:
    path = tmp_path / "seeds.yaml"
    path.write_text(SEEDED, encoding="utf-8")
    console = Console(quiet=True)
    folder = run_recipe(
        path, tmp_path / "run", overrides=["same.train.seed=7", "other.train.seed=8"], console=console
    )
    found = {
        name: next((folder / "stages" / name).glob("*.safetensors")).read_bytes()
        for name in ("tokenizer", "same", "other")
    }
    assert found["tokenizer"] == found["same"] != found["other"]


@pytest.mark.parametrize(("given", "want"), [({}, 7), ({"seed": 0}, 0), ({"seed": 3}, 3)])
def test_zero_is_a_seed(given: dict[str, int], want: int, tmp_path: Path) -> None:
    config = SynthStageConfig.parse({"clips": 2, "test_fraction": 0.0, "val_fraction": 0.0} | given, "data")
    assert SynthStageConfig.parse(config.dump(), "the resolved recipe") == config
    console = Console(quiet=True)
    run_synth(StageContext("data", "made", config, tmp_path, {}, 7, Hardware(), console, StageCache()))
    manifest = Manifest.load_json(tmp_path / "shards/manifest.json")
    assert manifest.options["seed"] == want
    found = ShardDataset.open(tmp_path / "shards", "train")
    same = SynthConfig(clips=2, test_fraction=0.0, val_fraction=0.0, seed=want)
    for i in range(2):
        index = int(found.ids[i].rpartition("-")[2])
        np.testing.assert_array_equal(found.motion(i), make_sample(index, config=same).motion)


def test_dances_to_rhythm_are_made_again_for_another_tracker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "beats.safetensors"
    other.write_bytes(b"another tracker")
    kind = stage_kind("synth", "data")

    def facts(columns: str) -> object:
        dances = {"dances": {"songs": 2, "columns": columns}, "min_seconds": 4.0}
        return kind.external(SynthStageConfig.parse(dances, "data"))

    before = [facts(columns) for columns in ("public", "rhythm")]
    monkeypatch.setattr("motionloom.pipeline.stages.data.data.WEIGHTS", other)
    after = [facts(columns) for columns in ("public", "rhythm")]
    assert before[0] == after[0] == {} and before[1] != after[1]
