"""Going on from an exported model with BVH clips of one's own: what is taken over, and what is refused."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from bvh_clips import write_clip
from rich.console import Console
from safetensors.torch import load_file

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.contract.lookup import BundleFile
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.runs.api import export_run, run_recipe
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.runs.recipe import Recipe, load_recipe
from motionloom.pipeline.store.artifact import Artifact
from motionloom.pipeline.store.data import Data

QUIET = Console(quiet=True)
pytestmark = pytest.mark.slow

SHORT = """
extends: finetune
name: mine
start: {start}
hardware: {{accelerator: cpu, threads: 1, convert_workers: 1}}
stages:
  data: {{source: clips, captions: clips/captions.jsonl, look: 0}}
  tokenizer:
    net: {{reset_below: 0.01}}
    train: {{steps: 2, batch_size: 4, checkpoint_every: 2, validate_every: 2}}
  tma: {{train: {{steps: 2, batch_size: 4, checkpoint_every: 2, validate_every: 2}}}}
  gpt: {{train: {{steps: 6, batch_size: 4, checkpoint_every: 2, validate_every: 4}}}}
"""


@dataclass(frozen=True)
class Mine:
    """An exported model, a folder of clips and a recipe that goes on with them."""

    exported: Path
    recipe: Path

    def load(self, *sets: str) -> Recipe:
        """The recipe with `--set`."""
        return load_recipe(self.recipe, sets)


@pytest.fixture(scope="module")
def mine(small_run: Any, tmp_path_factory: pytest.TempPathFactory) -> Mine:
    """Ten clips without fingers, captioned, and the export of the small run beside them."""
    root = tmp_path_factory.mktemp("mine")
    export_run(small_run.folder, root / "model", half=True, console=QUIET)
    rows = []
    (root / "clips").mkdir()
    for number in range(10):
        write_clip(root / "clips" / f"sway-{number}.bvh", number)
        split = {8: "val", 9: "test"}.get(number, "train")
        rows.append({"id": f"sway-{number}", "caption": f"somebody sways, take {number}", "split": split})
    (root / "clips/captions.jsonl").write_text("\n".join(map(json.dumps, rows)))
    (root / "mine.yaml").write_text(
        SHORT.format(start="model")
        .replace("source: clips", f"source: {root}/clips")
        .replace("captions: clips", f"captions: {root}/clips")
    )
    return Mine(root / "model", root / "mine.yaml")


def test_stages_are_those_of_the_model(mine: Mine) -> None:
    recipe = mine.load("data.unit=cm")
    at = {name: str(mine.exported / name) for name in ("stats", "tokenizer", "tma", "gpt")}
    kept = {name: Artifact.load_json(mine.exported / name / "artifact.json") for name in ("tokenizer", "gpt")}

    def places(stage: str) -> dict[str, str]:
        return {
            role: str(Path(name).resolve())
            for role, name in recipe.stage(stage).inputs.items()
            if "/" in name
        }

    assert places("tokenizer") == {"stats": at["stats"], "start": at["tokenizer"]}
    assert places("tma") == {"stats": at["stats"], "start": at["tma"]}
    assert places("tokens") == {"stats": at["stats"]}
    assert places("gpt") == {"start": at["gpt"]}
    faces = ("face_gpt", "face_vae", "face_diffusion")
    assert places("generate") == {f"generators.model:{name}": str(mine.exported / name) for name in faces}
    assert list(recipe.stage("generate").inputs) == ["data", "generators.gpt", *places("generate")]
    data, gpt = recipe.stage("data").config, recipe.stage("gpt").config
    assert (data.layout, data.fps, data.fingers) == ("wholebody363", 20.0, "resting")
    assert gpt.net.dump() == kept["gpt"].config["net"] and gpt.prior == "tma"
    assert gpt.loss.align_weight == 0 and gpt.train.steps == 6 and gpt.optim.lr == 2e-3
    assert recipe.stage("tokenizer").kind.name == kept["tokenizer"].kind == "h2vq"


def test_what_is_left_out_is_the_models_own(mine: Mine, tmp_path: Path) -> None:
    recipe = mine.load("tokenizer=null", "tma=null")
    inputs = recipe.stage("gpt").inputs
    for role in ("tokenizer", "tma"):
        assert Path(inputs[role]).resolve() == mine.exported / role
        assert role not in [stage.name for stage in recipe.stages]
    assert Path(recipe.stage("evaluate").inputs["tokenizer"]).resolve() == mine.exported / "tokenizer"
    recipe = mine.load()  # resolved, it is the same without a start
    (tmp_path / "again.yaml").write_text(recipe.to_yaml())
    assert "\nstart:" not in recipe.to_yaml()
    assert load_recipe(tmp_path / "again.yaml").to_yaml() == recipe.to_yaml()


@pytest.mark.parametrize(
    ("sets", "says"),
    [
        (["start=nowhere"], "start = 'nowhere': nowhere: no such folder; .*synthetic"),
        (["data.layout=body133"], "layout = body133, but start .* was trained on layout wholebody363"),
        (["data.fps=30"], "stages.data.fps = 30, but start .* was trained on fps 20.0; leave it out"),
        (["gpt.net.heads=2"], "starts from .*model/gpt', which differs in net.heads; give both the same"),
        (["tokenizer.net.num_codes=8"], "'tokenizer' starts from .* which differs in net.num_codes;"),
        (["tma.net.layers=3"], "'tma' starts from .* which differs in net.layers;"),
        (["tokenizer.kind=vq"], "'gpt' starts from .* which differs in inputs.tokenizer;"),
        (["stages.tokenizer={kind: vq, inputs: {start: MODEL/tokenizer}}"], r"differs in kind \(h2vq\);"),
        (["text.encoder=another"], "'tma' starts from .* differs in inputs.text; give"),
        (["stages.face_gpt={}"], "stages.face_gpt has no kind, and start .* has no 'face_gpt' to go on from"),
        (["stages.stats={kind: stats}"], "'tokenizer' starts .* differs in inputs.stats; .*model/stats}"),
        (["start=UDE"], r"kind gpt; .* ude"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_before_anything_runs(
    mine: Mine, ude_run: Any, sets: list[str], says: str
) -> None:
    places = {"MODEL": str(mine.exported), "UDE": str(ude_run.folder)}
    with pytest.raises(UserError, match=says):
        mine.load(*(re.sub("MODEL|UDE", lambda found: places[found[0]], text) for text in sets))


def test_a_run_is_gone_on_from_and_exported_with_the_stages_of_the_other(
    mine: Mine, small_run: Any, tmp_path: Path
) -> None:
    other = Path(shutil.copytree(small_run.folder, tmp_path / "other"))
    sets = [f"start={other}", "tokenizer=null", "tma=null", "gpt.optim.lr=1e-9"]
    sets += ["gpt.optim.warmup_steps=0", "gpt.train.steps=1"]
    run = run_recipe(
        mine.recipe, tmp_path / "run", overrides=sets, select=Selection(until="gpt"), console=QUIET
    )
    before, after = (load_file(r / "stages/gpt/model.safetensors") for r in (other, run))
    assert before.keys() == after.keys()
    for name, weights in before.items():  # one step of 1e-9
        torch.testing.assert_close(after[name], weights, rtol=0, atol=1e-7)
    made = MotionModel(run).generate(["a person waves"], seconds=2.0, seed=1)[0]
    export_run(run, tmp_path / "exported", console=QUIET)
    assert {"tokenizer", "text", "tma"} <= {path.parent.name for path in tmp_path.glob("exported/*/*.json")}
    other.rename(tmp_path / "away")
    again = MotionModel(tmp_path / "exported").generate(["a person waves"], seconds=2.0, seed=1)[0]
    np.testing.assert_array_equal(again.features, made.features)
    with pytest.raises(UserError, match=f"stage 'gpt' was made from {other}/stages/tma, where no"):
        Bundle.open(run)


def test_it_trains_every_weight_and_exports_the_models_face(mine: Mine, tmp_path: Path) -> None:
    trained = run_recipe(mine.recipe, tmp_path / "run", select=Selection(until="gpt"), console=QUIET)
    before, after = (
        load_file(p / "model.safetensors") for p in (mine.exported / "gpt", trained / "stages/gpt")
    )
    assert before.keys() == after.keys()
    assert not any(torch.equal(value, before[name].float()) for name, value in after.items())
    data = Data(trained / "stages/data").split("train")
    assert data.layout.name == "wholebody363" and data.layout.fps == 20
    # What its pages, commands and exports read: its own body, and the face of the model it started from.
    export_run(trained, tmp_path / "out", console=QUIET)
    facts = BundleFile.load_json(tmp_path / "out/bundle.json")
    assert facts.generators == ("gpt", "face_gpt", "face_vae", "face_diffusion")
    made = MotionModel(tmp_path / "out").generate(["somebody sways"], seconds=2.0, seed=1)[0]
    again = MotionModel(trained).generate(["somebody sways"], seconds=2.0, seed=1)[0]
    np.testing.assert_array_equal(made.features, again.features)
    assert made.joints.shape == (40, 52, 3) and made.face is not None
