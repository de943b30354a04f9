"""`--json` prints JSON and nothing else; `--version` and completion answer without the libraries."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from bvh_clips import write_clip, write_map

from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.cli.json_output import plain

Call = Callable[..., Any]

DRY = """
name: dry
stages:
  data: {kind: synth, clips: 3}
  stats: {kind: stats}
"""


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three synthetic clips."""
    root = tmp_path_factory.mktemp("json") / "shards"
    synthesize(SynthConfig(clips=3, min_seconds=2.0, max_seconds=5.0), root, progress=False)
    return root


def loaded(text: str) -> Any:
    """Strict JSON: Python's NaN is none."""

    def refuse(name: str) -> None:
        raise ValueError(name)

    return json.loads(text, parse_constant=refuse)


def test_every_kind_of_value_has_its_form() -> None:
    @dataclass
    class Inner:
        place: Path
        figures: tuple[float, ...]

    value = {"a": Inner(Path("x/y"), (1.5, float("nan"), float("inf"))), 2: {"b", "a"}, "c": Counter(z=3)}
    assert plain(value) == {
        "a": {"place": "x/y", "figures": [1.5, None, None]},
        "2": ["a", "b"],
        "c": {"z": 3},
    }
    assert plain(SynthConfig(clips=3))["clips"] == 3
    with pytest.raises(TypeError, match="object has no form in JSON"):
        plain({"a": object()})


def test_info(call: Call) -> None:
    shown = call("info", "--json")
    facts = loaded(shown.out)
    assert shown.code == 0 and facts["motionloom"] == metadata.version("motionloom")
    assert facts["libraries"]["torch"] == metadata.version("torch")
    assert "humantomato-tiny" in facts["recipes"] and facts["gpus"] is not None


def test_a_plan(call: Call, tmp_path: Path) -> None:
    recipe = tmp_path / "dry.yaml"
    recipe.write_text(DRY)
    shown = call("run", recipe, "--out", tmp_path / "run", "--dry-run", "--json")
    plan = loaded(shown.out)
    assert [(row["stage"], row["action"], row["reason"]) for row in plan["stages"]] == [
        ("data", "run", "never run"),
        ("stats", "run", "never run"),
    ]
    assert plan["stages"][1]["inputs"] == {"data": "data"} and plan["replaces"] == {
        "finished": [],
        "started": [],
    }
    assert not (tmp_path / "run").exists()
    refused = call("run", recipe, "--out", tmp_path / "run", "--json")
    assert refused.code == 2 and "give --dry-run too" in refused.err and not refused.out


def test_a_check_of_shards_and_of_files(call: Call, shards: Path, tmp_path: Path) -> None:
    shown = call("data", "check", shards, "--json")
    found = loaded(shown.out)
    assert shown.code == 0 and found["problems"] == 0 and found["clips"] == 3 and "no problems" in shown.err
    (tmp_path / "bad.bvh").write_text("no BVH")
    shown = call("data", "check", tmp_path / "bad.bvh", "--json")
    found = loaded(shown.out)
    assert shown.code == 1 and found["problems"] == 1
    assert found["files"][0]["ok"] is False and found["files"][0]["problems"]


def test_a_conversions_plan(call: Call, tmp_path: Path) -> None:
    (tmp_path / "mocap").mkdir()
    write_clip(tmp_path / "mocap" / "a.bvh", 1)
    words = ("data", "convert", "bvh", tmp_path / "mocap", tmp_path / "out", "--licence", "x")
    words += ("--joint-map", write_map(tmp_path / "map.json"), "--workers", "1")
    plan = loaded(call(*words, "--plan", "--json").out)
    assert plan["found"] == 1 and sum(plan["clips"].values()) == 1 and not plan["unreadable"]
    refused = call(*words, "--json")
    assert refused.code == 2 and "give --plan too" in refused.err and not (tmp_path / "out").exists()


def test_a_table_has_its_own_form(call: Call) -> None:
    refused = call("evaluate", "--tables", "--json")
    assert refused.code == 2 and "--format json" in refused.err


def test_the_version(call: Call) -> None:
    shown = call("--version")
    assert (shown.code, shown.out) == (0, f"motionloom {metadata.version('motionloom')}\n")


def test_completion_knows_the_commands(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("_MOTIONLOOM_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", "motionloom data ch")
    monkeypatch.setenv("COMP_CWORD", "2")
    shown = call("data", "ch")
    assert shown.code == 0 and shown.out.split() == ["check"]
