"""A GPT stage that starts from another's weights and aligns the motions it samples, as a user runs it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from safetensors.torch import load_file

from motionloom.pipeline.store.training_log import read_training_log

MORE: dict[str, Any] = {
    "kind": "gpt",
    "inputs": {"start": "gpt"},
    "net": {"layers": 1, "dim": 48, "heads": 4, "ff": 96},
    "loss": {"align_on": "samples", "align_weight": 1.0},
    "optim": {"lr": 1e-12, "weight_decay": 0.0},
    "train": {"steps": 4, "batch_size": 8, "checkpoint_every": 2, "validate_every": 2},
}


@pytest.fixture
def run(small_run: Any, tmp_path: Path, call: Callable[..., Any]) -> Callable[..., tuple[Any, Path]]:
    """`run(loss={...}) -> (outcome, folder)`: the stage `more` on a copy of the finished run."""
    folder = tmp_path / "run"
    shutil.copytree(small_run.folder, folder)

    def go(*arguments: str, **changes: Any) -> tuple[Any, Path]:
        recipe = yaml.safe_load(small_run.recipe.read_text())
        net = recipe["stages"]["gpt"]["net"]
        tiny = yaml.safe_load((Path(__file__).parents[3] / "configs/humantomato/tiny.yaml").read_text())
        more = {**MORE, "net": {**tiny["stages"]["gpt"]["net"], **net}, **changes}
        recipe["stages"]["more"] = more
        path = tmp_path / "more.yaml"
        path.write_text(yaml.safe_dump(recipe))
        return call("run", path, "--out", folder, "--until", "more", *arguments), folder / "stages/more"

    return go


def test_a_stage_starts_from_anothers_weights(run: Callable[..., tuple[Any, Path]]) -> None:
    """With steps too small to see, they are the same; the alignment of samples is logged and validated."""
    outcome, folder = run()
    assert outcome.code == 0, outcome.err
    before = load_file(folder.parent / "gpt/model.safetensors")
    after = load_file(folder / "model.safetensors")
    torch.testing.assert_close(after, before, rtol=0, atol=1e-9)
    rows = [row for row in read_training_log(folder) if "val/align" in row]
    assert [row["step"] for row in rows] == [2, 4]
    assert rows[0]["val/align"] == pytest.approx(rows[1]["val/align"], rel=1e-3)
    assert 0 < rows[0]["val/align"] < 20


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"net": {**MORE["net"], "heads": 2}}, "in net.heads;"),
        ({"prior": "sentence"}, "in prior;"),
        ({"inputs": {"start": "face_gpt"}}, "in net.ff, net.dim, prior, inputs.tokenizer, inputs.tma;"),
        ({"inputs": {"start": "tma"}}, "gpt or face_gpt"),
        # Motions are sampled token by token.
        ({"train": {**MORE["train"], "compile": True}}, "token by token"),
        ({"train": {**MORE["train"], "strategy": "fsdp"}}, "token by token"),
    ],
)
def test_what_cannot_train_is_refused_before_anything_runs(
    run: Callable[..., tuple[Any, Path]], changes: dict[str, Any], says: str
) -> None:
    outcome, _ = run("--dry-run", **changes)
    assert outcome.code == 2
    assert says in " ".join(outcome.err.split())
