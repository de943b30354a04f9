"""One recipe for three engines: files as they were looked at (`golden/`), and what the engines ask of them.

The golden files have RECIPE in the recipe's place. That for SkyPilot was read by its own parser (0.14.1, no
package that the tests need), those for Kubernetes by the schema that JobSet 0.12 publishes, here reduced.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from rich.console import Console

from motionloom.datasets.base.errors import UserError
from motionloom.pipeline.results.paper.fill import rows_of
from motionloom.pipeline.runs.cluster.launch import Engine, launch_recipe
from motionloom.pipeline.runs.recipe import load_recipe

GOLDEN = Path(__file__).parent / "golden"
RECIPE = """
name: small
seed: 5
stages:
  data: {kind: bvh, source: mocap, licence: CC0}
  stats: {kind: stats}
  tokenizer: {kind: rvq, net: {part: body}, train: {batch_size: 64}}
  evaluate: {kind: evaluate}
"""
ASKED = ("image=registry.example.org/motionloom:1", "volume=motion", "clips_per_gpu=16", "parts=4")
BUCKET = ("image=i", "bucket=s3://mine")


@pytest.fixture
def recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    Path("small.yaml").write_text(RECIPE)
    return "small.yaml"


def launched(recipe: str, on: Engine, *options: str, **how: Any) -> str:
    """What a dry run prints."""
    console = Console(file=io.StringIO(), width=200)
    launch_recipe(recipe, on=on, options=options, dry_run=True, console=console, **how)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


@pytest.mark.parametrize("on", ["kubernetes", "sky"])
def test_files_are_as_they_were_looked_at(recipe: str, on: Engine) -> None:
    options = (*ASKED, *{"kubernetes": ("queue=gpu",), "sky": ("infra=k8s",)}[on])
    docs = list(yaml.safe_load_all(launched(recipe, on, *options, nodes=2, gpus_per_node=2)))
    for doc in docs:
        place, key = (doc, "recipe.yaml") if "data" in doc else (doc, "MOTIONLOOM_RECIPE")
        place = doc.get("data", doc.get("envs", {}))
        if text := place.get(key):
            Path("given.yaml").write_text(text)
            assert load_recipe("given.yaml") == load_recipe(recipe)
            place[key] = "RECIPE"
    assert docs == list(yaml.safe_load_all((GOLDEN / f"{on}.yaml").read_text()))


@pytest.mark.parametrize("name", ["humantomato-paper", "ude-paper", "baselines-paper", "small.yaml"])
def test_jobsets_keep_to_the_published_schema(recipe: str, name: str) -> None:
    _, jobs = yaml.safe_load_all(launched(name, "kubernetes", *ASKED, "queue=gpu", nodes=2))
    schema = jsonschema.Draft202012Validator(json.loads((GOLDEN / "jobset.schema.json").read_text()))
    assert not list(schema.iter_errors(jobs))
    before: set[str] = set()
    for job in jobs["spec"]["replicatedJobs"]:
        assert {one["name"] for one in job.get("dependsOn", ())} <= before
        pods = job["template"]["spec"]["completions"]
        assert len(f"{jobs['metadata']['name']}-{job['name']}-0-{pods - 1}") <= 63  # a host's name
        before.add(job["name"])
    job["template"]["spec"]["backofLimit"] = 0
    assert list(schema.iter_errors(jobs))


@pytest.mark.parametrize(
    ("on", "options", "message"),
    [
        ("kubernetes", ("volume=v",), "needs --cluster image="),
        ("sky", ("image=i",), "needs --cluster volume="),
        ("sky", (*BUCKET, "parts=2"), "a bucket serves one"),
    ],
)
def test_what_an_engine_needs_is_said(
    recipe: str, on: Engine, options: tuple[str, ...], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        launched(recipe, on, *options)


def test_the_recipe_may_say_what_the_cluster_is_asked(recipe: str) -> None:
    path = Path("own.yaml")
    path.write_text("extends: small.yaml\nhardware: {cluster: {image: i, bucket: 's3://mine', gpu: A100}}\n")
    tasks = list(yaml.safe_load_all(launched("own.yaml", "sky", "spot=false")))[2:]
    asked = [(task["resources"]["accelerators"], task["resources"]["use_spot"]) for task in tasks]
    assert asked == [({"A100": 2}, False)] and "cluster" not in load_recipe("own.yaml").to_yaml()


def test_a_sweep_is_an_array_with_a_folder_a_row(recipe: str) -> None:
    said = launched(recipe, "slurm", sweep=("tokenizer.optim.lr=1e-4,2e-4", "seed=1,2"), gpus_per_node=0)
    assert said.count("--array=1-4") == 2 and "--dependency=aftercorr:ID-OF-1-data" in said
    assert "recipe-3.yaml -o " in said and "/runs/small/tokenizer.optim.lr=2e-4,seed=1 " in said
    with pytest.raises(UserError, match="equal machines"):
        launched(recipe, "slurm", "clips_per_gpu=16", sweep=("tokenizer.train.batch_size=64,96",))
    with pytest.raises(UserError, match="write KEY=VALUE,VALUE"):
        launched(recipe, "slurm", sweep=("seed",))
    rows = [Path("sweep") / row for row in ("seed=1", "seed=2")]
    for row in rows:
        row.mkdir(parents=True)
        (row / "recipe.yaml").touch()
    assert rows_of([Path("sweep"), Path("other")]) == [*rows, Path("other")]


def test_arrays_are_no_larger_than_the_cluster_takes(recipe: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    said = launched(recipe, "slurm", "parts=2500", gpus_per_node=0)
    assert said.count("--array=1-1000\n") == 2 and "--array=1-500\n" in said
    assert '"$((SLURM_ARRAY_TASK_ID + 2000))/2500"' in said
    assert "afterok:ID-OF-1-parts:ID-OF-1-parts-from-1001:ID-OF-1-parts-from-2001 " in said
