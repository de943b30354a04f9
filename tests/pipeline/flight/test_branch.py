"""A training that branches off a kept checkpoint goes on with other settings; its records say so."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from safetensors.torch import load_file
from toy_training import toy_recipe

from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.fingerprint import fingerprint_fields
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.graph import Selection
from motionloom.pipeline.stages.train_config import BranchPoint, TrainConfig

Call = Callable[..., Any]
KEEP = "toy.train.keep_every=10"
QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patch:
        yield toy_recipe(tmp_path_factory.mktemp("branch"), patch)


@pytest.fixture(scope="module")
def trained(recipe: Path) -> Path:
    """30 steps, with the checkpoints of steps 10, 20, 25 and 30."""
    return run_recipe(recipe, recipe.parent / "trained", overrides=[KEEP], console=QUIET)


@pytest.fixture(scope="module")
def branch(trained: Path) -> Path:
    """From step 10 with half the learning rate, in a folder of its own."""
    return branched(trained, trained.parent / "branch", "10", "toy.optim.lr=0.005")


def branched(trained: Path, out: Path, checkpoint: str, *sets: str, **more: Any) -> Path:
    return run_recipe(
        trained / "recipe.yaml",
        out,
        overrides=[KEEP, *sets],
        select=Selection(only="toy"),
        from_checkpoint=checkpoint,
        console=QUIET,
        **more,
    )


def weights(run: Path) -> dict[str, Any]:
    return {name: value.tolist() for name, value in load_file(run / "stages/toy/model.safetensors").items()}


def test_it_equals_a_training_whose_rate_drops_there(trained: Path, branch: Path, recipe: Path) -> None:
    sets = ["toy.optim.drop_at=[10]", "toy.optim.drop_factor=0.5"]
    dropped = run_recipe(recipe, recipe.parent / "dropped", overrides=sets, console=QUIET)
    assert weights(branch) == weights(dropped) != weights(trained)
    rows = [run / "stages/toy/metrics.jsonl" for run in (branch, dropped, trained)]
    assert rows[0].read_text() == rows[1].read_text()
    assert rows[0].read_text().splitlines()[0] == rows[2].read_text().splitlines()[0]


def test_its_records_say_what_it_branched_from(trained: Path, branch: Path, call: Call) -> None:
    source = trained / "stages/toy/checkpoints/step=00000010.ckpt"
    artifact = json.loads((branch / "stages/toy/artifact.json").read_text())
    assert artifact["config"]["train"]["branch"] == {"step": 10, "sha256": sha256_of(source)}
    assert artifact["config"]["optim"]["lr"] == 0.005
    whole = json.loads((trained / "stages/toy/artifact.json").read_text())
    assert whole["config"]["train"]["branch"] is None and whole["fingerprint"] != artifact["fingerprint"]
    done = call("run", branch / "recipe.yaml", "-o", branch)
    assert done.code == 0 and "nothing to do" in done.out
    again = call(
        *("run", trained / "recipe.yaml", "-o", branch, "--only", "toy", "--from-checkpoint", 10),
        *("--set", "toy.optim.lr=0.005"),
    )
    assert again.code == 0 and "nothing to do" in again.out, again.err


def test_a_branch_that_was_killed_goes_on(branch: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    files = {path: path.read_bytes() for path in branch.rglob("*") if path.is_file()}
    for path, data in files.items():
        copy = run / path.relative_to(branch)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(data)
    stage = run / "stages/toy"
    (stage / "artifact.json").unlink()
    (stage / "model.safetensors").unlink()
    for step in (10, 25, 30):
        (stage / f"checkpoints/step={step:08d}.ckpt").unlink()
    # The checkpoint that it began with has gone; that it began is known.
    branched(run, run, "10", "toy.optim.lr=0.005")
    assert weights(run) == weights(branch)


def test_in_its_own_folder_it_must_be_asked_to_replace(trained: Path, branch: Path, tmp_path: Path) -> None:
    run = run_recipe(trained / "recipe.yaml", tmp_path / "run", overrides=[KEEP], console=QUIET)
    with pytest.raises(UserError, match="-o NEW keeps both, --replace begins it here"):
        branched(run, run, "10", "toy.optim.lr=0.005")
    branched(run, run, "10", "toy.optim.lr=0.005", replace=True)
    assert weights(run) == weights(branch)
    assert not list((run / "stages").glob(".*"))


def test_what_cannot_be_branched_is_refused(trained: Path, tmp_path: Path) -> None:
    out = tmp_path / "new"
    before = sorted(path for path in trained.rglob("*"))
    for wanted, sets, said in (
        ("15", [], r"no checkpoint of that step: .*trained has 10, 20, 25, 30; train.keep_every keeps more"),
        ("10", ["toy.train.steps=10"], "toy.train.steps=20"),
        (
            "10",
            ["toy.width=16"],
            r"another network .*encoder.0.weight is \[8, 6\] in the checkpoint and \[16, 6\]",
        ),
        ("nowhere.ckpt", [], "neither a step nor a checkpoint"),
    ):
        with pytest.raises(UserError, match=said):
            branched(trained, out, wanted, *sets)
    with pytest.raises(UserError, match="name its stage with --only"):
        run_recipe(trained / "recipe.yaml", out, from_checkpoint="10", console=QUIET)
    # In place, too, a checkpoint of another network is refused while all is as it was.
    with pytest.raises(UserError, match="another network"):
        branched(trained, trained, "10", "toy.width=16", replace=True)
    assert sorted(path for path in trained.rglob("*")) == before


def test_the_recipe_of_a_branch_alone_says_what_it_needs(branch: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--only toy --from-checkpoint STEP"):
        run_recipe(branch / "recipe.yaml", tmp_path / "other", console=QUIET)


def test_a_stage_that_does_not_branch_keeps_the_fingerprint_it_had() -> None:
    assert "branch" not in fingerprint_fields(TrainConfig())
    point = BranchPoint(step=3, sha256="0" * 64)
    assert fingerprint_fields(TrainConfig(branch=point))["branch"] == {"step": 3, "sha256": "0" * 64}
