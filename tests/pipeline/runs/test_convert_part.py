"""Parts of a recipe's conversion, made in the run folder before the stage runs there."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from bvh_clips import write_clip, write_map
from rich.console import Console

from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.options import Part
from motionloom.pipeline.runs import convert_part
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.convert_part import main, make_part

KEPT = "stages/data/shards"


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three captioned clips as the one stage of a recipe."""
    folder = tmp_path_factory.mktemp("source")
    source = folder / "clips"
    source.mkdir()
    names = [f"walk_{number}" for number in range(3)]
    for number, name in enumerate(names):
        write_clip(source / f"{name}.bvh", number)
    captions = folder / "captions.jsonl"
    rows = [{"id": name, "captions": ["a person walks"], "split": "train"} for name in names]
    captions.write_text("".join(json.dumps(row) + "\n" for row in rows))
    fields = {
        "kind": "bvh",
        "source": str(source),
        "joint_map": str(write_map(folder / "map.json")),
        "captions": str(captions),
        "licence": "CC0-1.0",
    }
    path = folder / "recipe.yaml"
    path.write_text(
        json.dumps({"name": "parts", "hardware": {"convert_workers": 1}, "stages": {"data": fields}})
    )
    return path


def run(recipe: Path, out: Path) -> str:
    to = io.StringIO()
    run_recipe(recipe, out, console=Console(file=to, width=200))
    return to.getvalue()


def files(out: Path) -> dict[str, bytes]:
    folder = out / KEPT
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if p.suffix in {".tar", ".json", ".npz"}}


def test_parts_and_the_stage_make_what_the_stage_makes_alone(recipe: Path, tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    run(recipe, whole)
    (cut / "stages" / "data").mkdir(parents=True)
    (cut / "stages" / "data" / "of_another_run").touch()
    with pytest.raises(UserError, match="part 0 has not begun the stage"):
        make_part(recipe, cut, "data", Part(1, 2, "shards"), patience_seconds=0.0)
    assert (cut / "stages" / "data" / "of_another_run").exists()  # part 0 alone clears the folder
    for step in ("features", "shards"):
        for index in range(2):
            said = make_part(recipe, cut, "data", Part(index, 2, step))  # type: ignore[arg-type]
    assert said == "0 shards, 0 clips"  # one shard only: the first part's
    assert not (cut / "stages" / "data" / "of_another_run").exists()
    made = {path: path.stat().st_mtime_ns for path in (cut / KEPT).glob("*.tar")}
    assert len(made) == 1
    run(recipe, cut)
    assert files(cut) == files(whole)
    assert {path: path.stat().st_mtime_ns for path in made} == made  # found, not made again
    assert make_part(recipe, cut, "data", Part(0, 2, "shards")) == "finished already"
    assert "nothing to do" in run(recipe, cut)


def test_slurm_numbers_the_parts(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(recipe), str(tmp_path), "data", "shards", "4", "seed=3"]
    asked: list[object] = []

    def record(recipe: object, run: Path, name: str, part: Part, **options: object) -> str:
        asked.append((part, options))
        return "2 shards, 9 clips"

    monkeypatch.setattr(convert_part, "make_part", record)
    for name in (convert_part.INDEX, convert_part.CPUS):
        monkeypatch.delenv(name, raising=False)
    assert main(words) == 2
    assert "start this as an array of jobs" in capsys.readouterr().err
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "3")
    assert main(words) == 0
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "1")
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "6")
    assert main(words) == 0
    assert asked == [
        (Part(3, 4), {"overrides": ["seed=3"], "workers": 1}),
        (Part(1, 4), {"overrides": ["seed=3"], "workers": 6}),
    ]
    assert capsys.readouterr().out.splitlines()[0] == "data: shards 4 of 4: 2 shards, 9 clips"
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "4")
    assert main(words) == 2
    assert "part 4 of 4" in capsys.readouterr().err


def test_other_stages_have_no_parts(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="only conversions are made in parts"):
        make_part("humantomato-tiny", tmp_path, "tokenizer", Part(0, 2))
