"""The commands as a user meets them: help that teaches, mistakes answered in one sentence, `--json`."""

from __future__ import annotations

import io
import json
import re
import shlex
import shutil
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from bvh_clips import write_clip, write_map
from program import commands
from rich.console import Console

from motionloom.datasets.base.records import Manifest
from motionloom.datasets.shards.index import ShardIndex
from motionloom.datasets.synth.generate import SynthConfig, synthesize
from motionloom.pipeline.cli.convert import say_manifest
from motionloom.pipeline.cli.options import plain

Call = Callable[..., Any]
ROOT = Path(__file__).parents[3]


COMMANDS = dict(commands())


def text_of(out: str) -> str:
    return re.sub(r"[\s│]+", " ", out)


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_help_teaches_with_an_example(words: tuple[str, ...], call: Call) -> None:
    shown = call(*words, "--help")
    assert shown.code == 0 and not shown.err
    text = text_of(shown.out)
    assert f"Usage: motionloom {' '.join(words)}" in text
    assert f"Example: motionloom {' '.join(words)} " in text


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few synthetic clips (made once; the tests that damage them copy them)."""
    root = tmp_path_factory.mktemp("data") / "shards"
    synthesize(SynthConfig(clips=24, min_seconds=2.0, max_seconds=5.0), root, progress=False)
    return root


@pytest.fixture
def damaged(shards: Path, tmp_path: Path) -> Path:
    """The same with one byte of a clip changed."""
    root = Path(shutil.copytree(shards, tmp_path / "damaged"))
    tar = next(root.glob("*-train-*.tar"))
    data = bytearray(tar.read_bytes())
    data[len(data) // 2] ^= 0xFF
    tar.write_bytes(data)
    return root


CONVERT = ("data", "convert", "bvh", "nowhere", "out", "--licence", "CC0")
MISTAKES: dict[str, tuple[list[str], str]] = {
    "unknown command": (["genrate"], "'generate'"),
    "unknown source": (["data", "convert", "bhv"], "'bvh'"),
    "unknown setting": ([*CONVERT, "--set", "looks=3"], "'look'"),
    "unknown option": (["run", "humantomato-tiny", "--outt", "x"], "--outt"),
    "unknown recipe": (["run", "humantomato-tin"], "'humantomato-tiny'"),
    "unknown stage": (["run", "humantomato-tiny", "--set", "tmaa.optim.lr=1"], "'tma'"),
    "unknown --until": (["run", "humantomato-tiny", "--until", "gtp", "--dry-run"], "'gpt'"),
    "no source folder": (["run", "bvh-body", "--set", "data.source=nowhere"], "nowhere: "),
    "no shards": (["run", "humantomato-paper", "--set", "data.path=nowhere"], "nowhere: "),
    "no caption": (["generate", "nowhere"], "caption"),
    "unknown format": (["generate", "nowhere", "a person walks", "-f", "npz,bhv"], "'bvh'"),
    "edit what is not there": (["edit", "nowhere", "walk.bvh"], "nowhere: no such folder"),
    "an unknown setting": (["edit", "nowhere", "walk.bvh", "--set", "secnds=8"], "'seconds'"),
    "a setting of nothing": (["generate", "nowhere", "a person walks", "--set", "colour=1"], "temperature"),
    "a task of nothing": (["edit", "nowhere", "walk.bvh", "--task", "no.yaml"], "no.yaml: cannot be read"),
    "convert nothing": ([*CONVERT, "--set", "joint_map=map.json"], "map.json: "),
    "synth of a wrong layout": (["data", "synth", "out", "--set", "layout=body13"], "layout"),
    "generate before a model is opened": (["generate", "nowhere", "jump", "-o", "file/sub"], "file: "),
    "report": (["report", "nowhere", "-o", "folder"], "folder: "),
    "run of an empty recipe": (["evaluate", "empty"], "empty/recipe.yaml: "),
    "model of an empty recipe": (["generate", "empty", "jump"], "empty/recipe.yaml: "),
    "model of no YAML": (["export", "broken", "-o", "new"], "broken/recipe.yaml: "),
    "model of stages without a kind": (["export", "kindless"], "kindless/recipe.yaml: "),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_answered_in_a_sentence(
    name: str, shards: Path, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("folder", "empty", "broken", "kindless"):
        (tmp_path / folder).mkdir()
    files = {"file": "", "empty/recipe.yaml": "", "broken/recipe.yaml": "stages: [", "kindless/recipe.yaml":
             "stages: {gpt: 3}"}  # fmt: skip
    for path, text in files.items():
        (tmp_path / path).write_text(text)
    before = sorted(tmp_path.rglob("*"))
    words, says = MISTAKES[name]
    done = call(*(str(shards) if word == "SHARDS" else word for word in words))
    assert done.code == 2 and says in text_of(done.err) and "Traceback" not in done.err + done.out
    assert len(done.err.strip().splitlines()) == 1 or name.startswith("unknown ")
    assert sorted(tmp_path.rglob("*")) == before, "a refused command left files behind"


def test_a_run_on_damaged_shards_is_refused(damaged: Path, tmp_path: Path, call: Call) -> None:
    run = tmp_path / "run"
    done = call("run", "humantomato-paper", "--set", f"data.path={damaged}", "--out", run, "--until", "stats")
    assert done.code == 2 and str(damaged) in done.err and "motionloom data check" in done.err
    assert not (run / "stages/data/artifact.json").exists()


def test_synth_writes_the_same_shards_as_the_function(shards: Path, tmp_path: Path, call: Call) -> None:
    out = tmp_path / "made"
    done = call("data", "synth", out, "--clips", 6, "--set", "layout=body133", "--workers", 1)
    assert done.code == 0 and "body133" in done.out
    assert call("data", "check", out).code == 0
    made = {path: path.read_bytes() for path in out.iterdir()}
    other = call("data", "synth", out, "--clips", 4, "--set", "layout=wholebody363", "--workers", 1)
    assert other.code == 2 and "clips 6 -> 4" in other.err and "choose another folder" in other.err
    assert made == {path: path.read_bytes() for path in out.iterdir()}
    again = call("data", "synth", out, "--clips", 6, "--set", "layout=body133", "--workers", 1)
    assert again.code == 0 and made == {path: path.read_bytes() for path in out.iterdir()}


def test_text_of_a_manifest_adds_no_line_and_commands_no_terminal(shards: Path) -> None:
    manifest = Manifest.load_json(shards / "manifest.json")
    hostile = manifest.model_copy(update={"licence": "CC0\nerror: \x1b[31m", "licences": {}})
    shown = Console(file=io.StringIO(), width=200)
    say_manifest(hostile, shards, shown)
    assert r"CC0\nerror: \x1b[31m" in shown.file.getvalue() and "\x1b" not in shown.file.getvalue()  # type: ignore[attr-defined]


def test_a_wrong_axis_is_seen_by_plan_conversion_and_check(tmp_path: Path, call: Call) -> None:
    source, out = tmp_path / "mocap", tmp_path / "out"
    for seed in range(3):
        write_clip(source / f"{seed}.bvh", seed, z_up=True)
    joint_map = write_map(tmp_path / "joint_map.json")
    more = ("--set", f"joint_map={joint_map}", "--licence", "CC0", "--workers", 1, "--set", "up=y")
    words = ("data", "convert", "bvh", source, out, *more)
    plan = call(*words, "--plan")
    assert plan.code == 0 and not out.exists()
    assert "0 of 3, " in plan.out and "try: --set up=z" in plan.out
    assert plan.out.rstrip().endswith(f"--set joint_map={joint_map} --set up=z")
    refused = call(*words)
    assert refused.code == 2 and "--set up=z" in refused.err
    assert call(*words, "--set", "up=z").code == 0
    again = call(*words, "--set", "up=z")
    assert again.code == 0 and "finished already, " in again.out
    lying = tmp_path / "lying"
    assert call(*words[:4], lying, *more, "--set", "look=0").code == 0
    assert call("data", "check", lying).code == 1


def test_an_unchanged_conversion_is_not_planned(tmp_path: Path, call: Call) -> None:
    source, out = tmp_path / "mocap", tmp_path / "out"
    write_clip(source / "1.bvh", 1)
    joint_map = write_map(tmp_path / "joint_map.json")
    words = ("data", "convert", "bvh", source, out, "--licence", "CC0", "--set", f"joint_map={joint_map}")

    def plans(*more: str) -> bool:
        done = call(*words, *more)
        assert done.code == 0
        return "nothing has changed" not in done.out

    assert plans() and not plans()
    for changed in (source / "1.bvh", joint_map, next(out.glob("*.tar")), out / "index.npz"):
        changed.write_bytes(changed.read_bytes())
        assert plans() and not plans(), changed
    write_clip(source / "sub/2.bvh", 2)
    assert plans() and not plans() and plans("--set", "look=0")
    assert call("data", "check", out).code == 0 and not plans("--set", "look=0")
    next(out.glob("*.tar")).unlink()
    assert plans("--set", "look=0") and not plans("--set", "look=0")


def test_parts_are_planned_made_and_joined(tmp_path: Path, call: Call) -> None:
    (tmp_path / "splits").mkdir()
    for seed, split in enumerate(("train", "val", "test")):
        write_clip(tmp_path / f"mocap/{seed}.bvh", seed)
        (tmp_path / f"splits/{split}.txt").write_text(f"{seed}\n")
    words = ("data", "convert", "bvh", tmp_path / "mocap", "--licence", "CC0", "--workers", 1)
    splits, out, whole = ("--set", f"splits={tmp_path / 'splits'}"), tmp_path / "out", tmp_path / "whole"
    assert call("data", "join", tmp_path).code == 2 and call(*words, out, "--part", "3/2").code == 2
    plan = call(*words, out, *splits, "--part", "1/2", "--plan").out.splitlines()
    assert plan[-1].endswith("--part 1/2") and not list(out.glob("*.tar"))
    assert call(*words, out, *splits, "--part", "1/2").code == 0
    tars = [ShardIndex.load_json(path) for path in out.glob("*.index")]
    assert f"part 1/2: {len(tars)} shards, {sum(len(tar.clips) for tar in tars)} clips" in plan
    assert call(*words, out, *splits, "--set", "fps=10", "--part", "2/2").code == 0
    other = call("data", "join", out)
    assert other.code == 2 and "fps 20.0 -> 10.0" in other.err and not (out / "manifest.json").exists()
    assert call(*words, out, *splits, "--part", "2/2").code == 0
    (out / "bvh-val-000000.tar").write_bytes(b"damaged")
    missing = call("data", "join", out)
    assert missing.code == 2 and "--part 2/2" in missing.err
    assert call(*words, out, *splits, "--part", "2/2").code == 0
    assert call("data", "join", out).code == call("data", "join", out).code == 0
    assert call(*words, whole, *splits).code == 0
    assert {path.name: path.read_bytes() for path in out.glob("[!.]*.*")} == {
        path.name: path.read_bytes() for path in whole.glob("[!.]*.*")
    }


ODD = {
    "freebvh": 1, "momask_template": 1, "sfu_affective_vicon": 1, "virvig_dancedb_metres": 1,
    "makehuman_blender": 0, "": 4,
}  # fmt: skip
"""Files of other makers, each in a unit, with an axis and names of its own, and their folder: clips of each;
one has a single frame."""


@pytest.mark.parametrize("name", ODD)
def test_the_line_that_a_plan_proposes_converts_files_of_other_makers(
    name: str, shared: Path, tmp_path: Path, call: Call
) -> None:
    source = shared / "data/real/odd_bvh" / (f"{name}.bvh" if name else "")
    plan = call("data", "convert", "bvh", source, tmp_path / "out", "--plan", "--set", "look=9")
    assert plan.code == 0, plan.err
    (line,) = (line for line in plan.out.splitlines() if "convert" in line.split("│")[0])
    if not ODD[name]:
        assert line.startswith("nothing ")
        return
    assert "problem:" not in plan.out
    words = shlex.split(line.removeprefix("convert it: "))
    assert words[:2] == ["motionloom", "data"] and "--licence" in words
    assert call(*words[1:]).code == 0
    manifest = Manifest.load_json(tmp_path / "out" / "manifest.json")
    assert sum(shard.samples for shard in manifest.shards) == ODD[name]


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (ZeroDivisionError("a bug"), 1, "ZeroDivisionError: a bug"),
        (KeyboardInterrupt(), 130, "the same command goes on from here"),
    ],
    ids=repr,
)
def test_bugs_and_ctrl_c(
    error: BaseException, code: int, says: str, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("motionloom.pipeline.cli.info.show_info", fail)
    done = call("info")
    assert done.code == code and says in done.err


DRY = """
name: dry
stages:
  data: {kind: synth, clips: 3}
  stats: {kind: stats}
"""


def loaded(text: str) -> Any:
    """Strict JSON: Python's NaN is none."""

    def refuse(name: str) -> None:
        raise ValueError(name)

    return json.loads(text, parse_constant=refuse)


def test_json_has_no_nan() -> None:
    assert plain({"a": (1.5, float("nan"), Path("x"))}) == {"a": [1.5, None, "x"]}
    assert plain(SynthConfig(clips=3))["clips"] == 3


def test_a_check_of_shards(call: Call, shards: Path, damaged: Path) -> None:
    bad = call("data", "check", damaged)
    assert bad.code == 1 and "-train-" in bad.out and "sha256" in bad.out
    shown = call("data", "check", shards, "--json")
    found = loaded(shown.out)
    assert shown.code == 0 and found["problems"] == 0 and found["clips"] == 24 and "no problems" in shown.err


def test_info_the_version_and_a_table(call: Call) -> None:
    shown, facts = call("--version"), loaded(call("info", "--json").out)
    assert shown.code == 0 and shown.out == f"motionloom {facts['motionloom']}\n"
    assert facts["libraries"]["torch"] == metadata.version("torch") and "humantomato-tiny" in facts["recipes"]
    said = call("info").out
    for word in ("motionloom 0.", "torch 2.", "runs on:", "encoder: minilm", "humantomato-tiny", "bvh-body"):
        assert word in said
