"""The commands as a user meets them: help that teaches, mistakes answered in one sentence, small data."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from bvh_clips import write_clip, write_map
from foreign_figures import build, write_figure
from foreign_tools import FOREIGN
from safetensors.numpy import load_file

from motionloom.datasets.motion.joint_map import JointMap
from motionloom.pipeline.cli.main import app

Call = Callable[..., Any]


def commands(group: Any, *path: str) -> list[tuple[str, ...]]:
    """Every command of the program as its words."""
    if not hasattr(group, "list_commands"):
        return [path]
    names = group.list_commands(None)
    return [found for name in names for found in commands(group.get_command(None, name), *path, name)]


COMMANDS = commands(typer.main.get_command(app))


def text_of(out: str) -> str:
    return re.sub(r"[\s│]+", " ", out)


def test_the_commands_are_these() -> None:
    assert {" ".join(words) for words in COMMANDS} >= {
        "info",
        "run",
        "generate",
        "evaluate",
        "report",
        "export",
        "data synth",
        "data convert humanml3d",
        "data convert motionx",
        "data convert aistpp",
        "data convert amass",
        "data convert bvh",
        "data report",
        "retrieval",
        "data check",
        "data stats",
        "data joints",
    }


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_help_teaches_with_an_example(words: tuple[str, ...], call: Call) -> None:
    shown = call(*words, "--help")
    assert shown.code == 0 and not shown.err
    text = text_of(shown.out)
    assert f"Usage: motionloom {' '.join(words)}" in text
    assert f"Example: motionloom {' '.join(words)} " in text


def test_without_a_command_the_help_is_shown(call: Call) -> None:
    for words in ((), ("data",), ("data", "convert")):
        shown = call(*words)
        assert "Usage: motionloom" in shown.out + shown.err


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few synthetic clips (made once; the tests that damage them copy them)."""
    from motionloom.datasets.synth.generate import SynthConfig, synthesize

    root = tmp_path_factory.mktemp("data") / "shards"
    synthesize(SynthConfig(clips=24, min_seconds=2.0, max_seconds=5.0), root, progress=False)
    return root


@pytest.fixture
def damaged(shards: Path, tmp_path: Path) -> Path:
    """The same with one byte of a clip changed."""
    root = tmp_path / "damaged"
    root.mkdir()
    for path in shards.iterdir():
        (root / path.name).write_bytes(path.read_bytes())
    tar = next(root.glob("*-train-*.tar"))
    data = bytearray(tar.read_bytes())
    data[len(data) // 2] ^= 0xFF
    tar.write_bytes(data)
    return root


MISTAKES: dict[str, tuple[list[str], str]] = {
    "unknown command": (["trian"], "trian"),
    "unknown option": (["run", "humantomato-tiny", "--outt", "x"], "--outt"),
    "unknown recipe": (["run", "humantomato-tin"], "did you mean 'humantomato-tiny'"),
    "no recipe file": (["run", "nothing.yaml"], "nothing.yaml: no such recipe file"),
    "unknown stage": (["run", "humantomato-tiny", "--set", "tmaa.optim.lr=1"], "did you mean 'tma'"),
    "unknown field": (["run", "humantomato-tiny", "--set", "tma.optim.lrr=1"], "did you mean 'lr'"),
    "wrong type": (["run", "humantomato-tiny", "--set", "tma.train.steps=many"], "train.steps"),
    "wrong value": (
        ["run", "humantomato-tiny", "--set", "data.max_seconds=1"],
        "max_seconds must be at least",
    ),
    "no equals sign": (["run", "humantomato-tiny", "--set", "tma.optim.lr"], "stage.field=value"),
    "unknown kind": (["run", "humantomato-tiny", "--set", "tma.kind=tmaa"], "did you mean 'tma'"),
    "unknown --until": (["run", "humantomato-tiny", "--until", "gtp", "--dry-run"], "did you mean 'gpt'"),
    "unfinished input": (["run", "humantomato-tiny", "--only", "gpt"], "is not finished"),
    "no source folder": (["run", "bvh-body", "--set", "data.source=nowhere"], "nowhere: no such folder"),
    "no shards": (
        ["run", "humantomato-paper", "--set", "data.path=nowhere"],
        "nowhere: no such folder; set the path of the data stage",
    ),
    "not a run": (["generate", "nowhere", "a person walks"], "nowhere: no such folder"),
    "no caption": (["generate", "nowhere"], "give at least one caption"),
    "empty caption": (["generate", "nowhere", "a person walks", " "], "captions[1] is empty"),
    "no format": (["generate", "nowhere", "a person walks", "-f", ""], "names no format"),
    "negative seed": (["generate", "nowhere", "a person walks", "--seed", "-1"], "seed -1: a seed is"),
    "unknown format": (["generate", "nowhere", "a person walks", "-f", "npz,bhv"], "did you mean 'bvh'"),
    "evaluate nothing": (["evaluate", "nowhere"], "nowhere: no such folder"),
    "report nothing": (["report", "nowhere"], "nowhere: no such folder"),
    "export nothing": (["export", "nowhere"], "nowhere: no such folder"),
    "retrieval of nothing": (["retrieval", "nowhere"], "nowhere: no such folder"),
    "diffusion of the body": (
        ["run", "baselines-tiny", "--set", "face_diffusion.part=bodyhand"],
        "a diffusion stage makes faces only, not bodyhand",
    ),
    "check nothing": (["data", "check", "nowhere"], "nowhere: no such folder"),
    "stats of nothing": (["data", "stats", "nowhere"], "nowhere/manifest.json: no such file"),
    "convert nothing": (
        ["data", "convert", "bvh", "nowhere", "out", "--joint-map", "map.json", "--licence", "CC0"],
        "map.json: cannot read the joint map",
    ),
    "synth of a wrong layout": (["data", "synth", "out", "--layout", "body13"], "layout"),
    "synth of no clips": (["data", "synth", "out", "--clips", "0"], "clips"),
}


WRONG_PLACES: dict[str, tuple[list[str], str]] = {
    "generate": (["generate", "nowhere", "a person walks", "-o", "file"], "file: is a file"),
    "generate below": (["generate", "nowhere", "a person walks", "-o", "file/sub"], "file: is a file"),
    "synth": (["data", "synth", "file", "--clips", "4"], "file: is a file"),
    "export": (["export", "nowhere", "-o", "file"], "file: is a file"),
    "report": (["report", "nowhere", "-o", "folder"], "folder: is a folder; name a file"),
    "data report": (["data", "report", "SHARDS", "-o", "file/page.html"], "file: is a file"),
    "data stats": (["data", "stats", "SHARDS", "-o", "folder"], "folder: is a folder; name a file"),
    "check with the options of files": (
        ["data", "check", "SHARDS", "--layout", "foo", "--seconds", "3"],
        "--layout, --seconds is for single files",
    ),
    "run of an empty recipe": (["evaluate", "empty"], "empty/recipe.yaml: a recipe is a mapping"),
    "model of an empty recipe": (["generate", "empty", "jump"], "empty/recipe.yaml: holds no stages"),
    "model of no YAML": (["export", "broken", "-o", "new"], "broken/recipe.yaml: not valid YAML"),
    "model of stages without a kind": (["export", "kindless"], "kindless/recipe.yaml: holds no stages"),
}


@pytest.mark.parametrize("name", WRONG_PLACES)
def test_a_wrong_place_is_answered_in_a_sentence(
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
    words, says = WRONG_PLACES[name]
    done = call(*(str(shards) if word == "SHARDS" else word for word in words))
    assert done.code == 2 and says in text_of(done.err) and "Traceback" not in done.err
    assert len(done.err.strip().splitlines()) == 1
    assert sorted(tmp_path.rglob("*")) == before, "a refused command left files behind"


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_answered_in_a_sentence(
    name: str, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words, says = MISTAKES[name]
    done = call(*words)
    assert done.code == 2
    assert says in text_of(done.err)
    assert "Traceback" not in done.err + done.out
    assert len(done.err.strip().splitlines()) == 1 or name.startswith("unknown ")
    assert not list(tmp_path.iterdir()), "a refused command left files behind"


def test_check_lists_what_is_wrong(shards: Path, damaged: Path, call: Call) -> None:
    good = call("data", "check", shards)
    assert good.code == 0 and "no problems" in good.out
    bad = call("data", "check", damaged)
    assert bad.code == 1 and "-train-" in bad.out and "sha256" in bad.out


def test_a_run_on_damaged_shards_is_refused(damaged: Path, tmp_path: Path, call: Call) -> None:
    run = tmp_path / "run"
    done = call("run", "humantomato-paper", "--set", f"data.path={damaged}", "--out", run, "--until", "stats")
    assert done.code == 2 and str(damaged) in done.err and "motionloom data check" in done.err
    assert not (run / "stages/data/artifact.json").exists()


def test_synth_writes_the_same_shards_as_the_function(shards: Path, tmp_path: Path, call: Call) -> None:
    out = tmp_path / "made"
    done = call("data", "synth", out, "--clips", 6, "--layout", "body133", "--workers", 1)
    assert done.code == 0 and "body133" in done.out
    assert call("data", "check", out).code == 0
    made = {path: path.read_bytes() for path in out.iterdir()}
    other = call("data", "synth", out, "--clips", 4, "--layout", "wholebody363", "--workers", 1)
    assert other.code == 2 and "clips 6 -> 4" in other.err and "choose another folder" in other.err
    assert made == {path: path.read_bytes() for path in out.iterdir()}
    again = call("data", "synth", out, "--clips", 6, "--layout", "body133", "--workers", 1)
    assert again.code == 0 and made == {path: path.read_bytes() for path in out.iterdir()}


def test_stats_describes_and_writes(shards: Path, tmp_path: Path, call: Call) -> None:
    out = tmp_path / "new/folder/stats.safetensors"
    done = call("data", "stats", shards, "--out", out)
    assert done.code == 0 and "clip length: median" in done.out and "root height" in done.out
    first, stored = out.read_bytes(), load_file(out)
    assert stored["mean"].shape == stored["std"].shape == (363,) and (stored["std"] > 0).all()
    assert np.isfinite(stored["mean"]).all()
    for _ in range(5):
        call("data", "stats", shards, "--out", out)
        assert out.read_bytes() == first, "equal statistics must be equal files"


def test_convert_plans_and_converts(tmp_path: Path, call: Call) -> None:
    source, out = tmp_path / "mocap", tmp_path / "out"
    text = write_clip(source / "control_ok.bvh", 0).read_text()
    (source / "frame_time_zero.bvh").write_text(re.sub(r"Frame Time: .*", "Frame Time: 0.0", text))
    joint_map = write_map(tmp_path / "joint_map.json")
    words = ("data", "convert", "bvh", source, out, "--joint-map", joint_map, "--licence", "CC-BY-NC-4.0")
    plan = call(*words, "--plan")
    assert plan.code == 0 and "frame_time_zero.bvh" in plan.out and not out.exists()
    strict = call(*words, "--strict", "--workers", 1)
    assert strict.code == 2 and "frame_time_zero.bvh" in strict.err and "Frame Time" in strict.err


def test_a_forgotten_axis_is_seen_by_plan_conversion_and_check(tmp_path: Path, call: Call) -> None:
    source, out = tmp_path / "mocap", tmp_path / "out"
    for seed in range(3):
        write_clip(source / f"{seed}.bvh", seed, z_up=True)
    joint_map = write_map(tmp_path / "joint_map.json")
    words = (
        "data",
        "convert",
        "bvh",
        source,
        out,
        "--joint-map",
        joint_map,
        "--licence",
        "CC0",
        "--workers",
        1,
    )
    plan = call(*words, "--plan")
    assert plan.code == 0 and not out.exists()
    assert "0 of 3, along +z of the files" in plan.out and "try: --up z" in plan.out
    refused = call(*words)
    assert refused.code == 2 and "no people standing on a floor" in refused.err and "--up z" in refused.err
    assert "problem" not in call(*words, "--up", "z", "--plan").out
    assert call(*words, "--up", "z").code == 0
    again = call(*words, "--up", "z")
    assert again.code == 0 and "finished already, " in again.out and "nothing to convert" in again.out
    assert call("data", "check", out).code == 0
    lying = tmp_path / "lying"
    assert call(*words[:4], lying, *words[5:], "--look", 0).code == 0
    found = call("data", "check", lying)
    assert (
        found.code == 1 and "3 of 3 clips (100%)" in found.out and "head is not above the pelvis" in found.out
    )


def test_joints_of_a_skeleton_and_of_a_file(tmp_path: Path, call: Call) -> None:
    named = call("data", "joints", "smplx52", "-o", tmp_path / "empty.json")
    assert named.code == 0 and "right_thumb3" in named.out and "left_wrist" in named.out
    rows = json.loads((tmp_path / "empty.json").read_text())["smplx52"]
    assert len(rows) == 52 and rows[22] == [22, "left_index1", None]
    source = write_figure_of("Mixamo", tmp_path / "mocap" / "walk.bvh")
    for where in (source, source.parent):
        shown = call("data", "joints", where, "-o", tmp_path / "map.json")
        assert shown.code == 0 and "mixamorig:LeftUpLeg" in shown.out and "22 by name" in shown.out
        assert shown.out.rstrip().splitlines()[-2] == "certain"
        assert JointMap.load(tmp_path / "map.json").sources[0] == ("mixamorig:Hips",)
    fingers = call("data", "joints", source, "--skeleton", "smplx52")
    assert "mixamorig:LeftHandIndex1" in fingers.out and "52 by name" in fingers.out
    wrong = call("data", "joints", "nowhere.bvh")
    assert wrong.code == 2 and "nowhere.bvh: no such file or folder" in wrong.err and "smpl22" in wrong.err


def test_convert_without_a_map_shows_the_guess(tmp_path: Path, call: Call) -> None:
    source, out = write_figure_of("Unreal mannequin", tmp_path / "mocap" / "walk.bvh"), tmp_path / "out"
    words = ("data", "convert", "bvh", source.parent, out, "--licence", "CC0")
    plan = call(*words, "--plan")
    assert plan.code == 0 and "guessed from walk.bvh; 22 by name" in text_of(plan.out)
    assert [path.name for path in out.iterdir()] == ["joint_map.json"]
    done = call(*words, "--joint-map", "auto", "--workers", 1)
    assert done.code == 0 and "note: joint_map.json: guessed from walk.bvh; 22 by name" in done.out


def write_figure_of(tool: str, path: Path) -> Path:
    write_figure(path, build(next(spec for spec in FOREIGN if spec.tool == tool)), frames=70)
    return path


def test_info_says_what_a_bug_report_needs(call: Call) -> None:
    done = call("info")
    assert done.code == 0
    for word in (
        "motionloom 0.",
        "torch 2.",
        "runs on:",
        "text encoder: minilm",
        "humantomato-tiny",
        "bvh-body",
    ):
        assert word in done.out


def test_a_bug_shows_its_traceback_and_gives_1(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr("motionloom.pipeline.cli.info.show_info", broken)
    done = call("info")
    assert done.code == 1 and "ZeroDivisionError: a bug" in done.err


def test_ctrl_c_says_how_to_go_on(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("motionloom.pipeline.cli.info.show_info", interrupted)
    done = call("info")
    assert done.code == 130 and "the same command goes on from here" in done.err
