"""A GPT trained on from that of another run, on other data, with its tokenizer."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rich.console import Console
from safetensors.torch import load_file

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.lookup import BundleFile
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.runs.api import export_run, run_recipe
from motionloom.pipeline.runs.recipe import load_recipe

QUIET = Console(quiet=True)
pytestmark = pytest.mark.slow


def child(folder: Path, run: Path, places: dict[str, str], **changes: Any) -> Path:
    """A recipe on new data whose GPT goes on from `run`'s with the stages at `places`."""
    made = yaml.safe_load((run / "recipe.yaml").read_text())
    gpt = made["stages"]["gpt"]
    gpt["train"].update(steps=1, batch_size=4)
    gpt["optim"].update(lr=1e-9, warmup_steps=0)
    gpt["inputs"] = {role: places[role] for role in ("tokenizer", "tma", "start")} | changes
    reading = {"tokenizer": places["tokenizer"], "stats": places["stats"]}
    recipe = {
        "name": "child",
        "hardware": made["hardware"],
        "stages": {
            "data": {**made["stages"]["data"], "clips": 12, "seed": 99},
            "text": made["stages"]["text"],
            "tokens": {**made["stages"]["tokens"], "inputs": reading},
            "gpt": gpt,
        },
    }
    path = folder / "child.yaml"
    path.write_text(yaml.safe_dump(recipe))
    return path


def stages_in(run: Path) -> dict[str, str]:
    names = {"tokenizer": "tokenizer", "stats": "stats", "tma": "tma", "start": "gpt"}
    return {role: str(run / name) for role, name in names.items()}


@pytest.fixture
def other(small_run: Any, tmp_path: Path) -> Path:
    """A copy of the small run, which may be moved."""
    return Path(shutil.copytree(small_run.folder, tmp_path / "other"))


def test_a_gpt_goes_on_from_that_of_another_run(other: Path, tmp_path: Path) -> None:
    recipe = child(tmp_path, other, stages_in(other / "stages"))
    with pytest.raises(UserError, match=r"differs in inputs.tokenizer; .* \{tokenizer: .*stages/tokenizer\}"):
        load_recipe(recipe, [f"gpt.inputs.tokenizer={other}/stages/face_tokenizer"])
    with pytest.raises(UserError, match=r"captions as 'text' encodes them, but its TMA .*other/stages/tma"):
        load_recipe(recipe, ["text.encoder=another"])
    run = tmp_path / "run"
    run_recipe(recipe, run, dry_run=True, console=QUIET)
    run_recipe(recipe, run, console=QUIET)
    before, after = (load_file(r / "stages/gpt/model.safetensors") for r in (other, run))
    assert before.keys() == after.keys()
    for name, weights in before.items():  # one step of 1e-9
        np.testing.assert_allclose(after[name].numpy(), weights.numpy(), atol=1e-7)

    made = Bundle.open(run).generate(["a person waves"], seconds=2.0, seed=1)[0]
    export_run(run, tmp_path / "exported", console=QUIET)
    facts = BundleFile.load_json(tmp_path / "exported/bundle.json")
    assert facts.generators == ("gpt",) and {"tokenizer", "text", "tma"} <= set(facts.stages)
    with pytest.raises(UserError, match="a whole export; name one of its stages"):
        load_recipe(recipe, [f"gpt.inputs.start={tmp_path / 'exported'}"])
    other.rename(tmp_path / "away")
    again = Bundle.open(tmp_path / "exported").generate(["a person waves"], seconds=2.0, seed=1)[0]
    np.testing.assert_array_equal(again.features, made.features)
    with pytest.raises(UserError, match=f"stage 'gpt' was made from {other}/stages/tokenizer, where no"):
        Bundle.open(run)
