"""Models that come with the package: found by name, listed, whole; the one that ships does what is said."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.schema import UserError
from motionloom.pipeline.cli.info import info
from motionloom.pipeline.inference import shipped_models as module
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.pretrained import MotionModel
from motionloom.pipeline.inference.shipped_models import model_folder, say_model, shipped_models

CAPTION = "a person waves with the left hand"
"""Of the README's first line."""


def fill(folder: Path) -> Path:
    """Two models' folders, as far as finding them goes, and what is none."""
    for name in ("lively", "calm"):
        (folder / name / "gpt").mkdir(parents=True)
        (folder / name / "bundle.json").write_text("{}")
        (folder / name / "gpt" / "model.safetensors").write_bytes(bytes(1000))
    (folder / "calm" / "card.json").write_text(json.dumps({"description": "moves slowly"}))
    (folder / "__pycache__").mkdir()
    (folder / "__init__.py").write_text("")
    return folder


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where models come from in place of the package's own; the current folder is another, empty one."""
    folder = fill(tmp_path / "package")
    monkeypatch.setattr(module, "_place", lambda: folder)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return folder


def test_models_are_what_has_a_folder(place: Path) -> None:
    found = shipped_models()
    assert list(found) == ["calm", "lively"]
    assert found["calm"].description == "moves slowly" and found["lively"].description == ""
    assert found["lively"].bytes == 1002 and found["lively"].folder == place / "lively"
    assert info()["models"]["calm"] == {"bytes": found["calm"].bytes, "description": "moves slowly"}


def test_a_folder_here_goes_first_and_it_is_said(place: Path) -> None:
    assert model_folder("calm") == model_folder(Path("calm")) == place / "calm"
    assert say_model("calm") == "calm: the model that comes with motionloom"
    Path("calm").mkdir()
    assert model_folder("calm") == Path("calm")
    said = str(say_model(Path("calm")))
    assert (
        said
        == f"calm: the folder {Path('calm').resolve()}, not the model of this name that comes with motionloom"
    )
    assert say_model("runs/calm") is None and model_folder("runs/calm") == Path("runs/calm")
    with pytest.raises(UserError, match=r"not a run folder.*; the model of this name is taken where no such"):
        Bundle.open("calm")


@pytest.mark.parametrize("opened", [Bundle.open, MotionModel.from_pretrained])
def test_an_unknown_name_lists_what_there_is(opened: Callable[[Any], Any], place: Path) -> None:
    with pytest.raises(UserError, match=r"zzz: no such folder, .*; models that come with .*: calm, lively$"):
        opened(Path("zzz"))
    with pytest.raises(UserError, match=r"lvely: no such folder; did you mean lively, the model that"):
        opened("lvely")
    with pytest.raises(UserError, match=r"^runs/zzz: no such folder, and none is here$"):
        opened(Path("runs/zzz"))


def test_out_of_a_packed_installation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Python imports packages from a zip file; the networks' files need a folder."""
    source = fill(tmp_path / "package")
    with zipfile.ZipFile(tmp_path / "packed.zip", "w") as archive:
        for path in sorted(source.rglob("*")):
            archive.write(path, f"pretrained/{path.relative_to(source)}")
    monkeypatch.setattr(module, "_place", lambda: zipfile.Path(tmp_path / "packed.zip", "pretrained/"))
    module._unpacked.cache_clear()
    found = shipped_models()
    assert list(found) == ["calm", "lively"] and found["calm"].description == "moves slowly"
    assert found["lively"].bytes == 1002
    folder = found["lively"].folder
    assert folder.name == "lively" and folder == found["lively"].folder, "unpacked once"
    assert {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()} == {
        "bundle.json",
        "gpt/model.safetensors",
    }
    module._unpacked.cache_clear()


@pytest.fixture
def synthetic() -> Iterator[Path]:
    """The folder of the model that ships."""
    found = shipped_models().get("synthetic")
    if found is None:
        pytest.skip("this tree has no weights in models/pretrained/synthetic")
    yield found.folder


def test_the_model_that_ships_is_small_and_whole(synthetic: Path) -> None:
    assert shipped_models()["synthetic"].bytes <= 20e6
    stages = json.loads((synthetic / "bundle.json").read_text())["stages"]
    weights = {p.relative_to(synthetic).as_posix(): sha256_of(p) for p in synthetic.glob("*/*.safetensors")}
    noted = {f"{name}/{file}": value for name, one in stages.items() for file, value in one["sha256"].items()}
    assert noted == weights
    model = MotionModel.from_pretrained("synthetic", device="cpu")
    assert model.modalities == {"text"} and model.bundle.faces and model.bundle.layout.has("face")


def test_the_readmes_first_line_waves_with_the_left_hand(
    synthetic: Path, call: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command as it stands in the README; its motion is judged by where the hands go."""
    monkeypatch.chdir(tmp_path)
    made = call("generate", "synthetic", CAPTION)
    assert made.code == 0, made.err
    assert "synthetic: the model that comes with motionloom" in made.err and "note:" not in made.err
    assert f"watch it in a browser: {tmp_path / 'motions/index.html'}" in made.err.splitlines()[-1]
    assert [Path(line).suffix for line in made.out.split()] == [".npz", ".bvh", ".mp4", ".html"]
    with np.load(made.out.split()[0], allow_pickle=False) as file:
        joints, facts = file["joints"].astype(np.float64), json.loads(str(file["metadata"]))
    assert facts["caption"] == CAPTION and len(joints) >= facts["fps"]
    number = {name: k for k, name in enumerate(facts["joint_names"])}

    def lifted(side: str) -> np.ndarray:
        """How far a wrist is above its elbow, frame by frame, metres."""
        return joints[:, number[f"{side}_wrist"], 1] - joints[:, number[f"{side}_elbow"], 1]

    across = joints[:, number["left_shoulder"]] - joints[:, number["right_shoulder"]]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    swing = ((joints[:, number["left_wrist"]] - joints[:, number["left_elbow"]]) * across).sum(axis=1)
    up = lifted("left") > 0.1
    assert up.mean() > 0.3 and (lifted("right") < 0.1).mean() > 0.9, (
        "the left hand is up, the right one is not"
    )
    turns = np.diff(np.sign(np.diff(swing[up])))
    assert np.ptp(swing[up]) > 0.1 and np.count_nonzero(turns) >= 2, "the hand goes to and fro"


def test_the_model_that_ships_says_what_it_does_not_know(synthetic: Path) -> None:
    model = MotionModel.from_pretrained("synthetic", device="cpu")
    (found,) = model.unknown([CAPTION, "the stock market fell sharply"])
    assert found.caption == "the stock market fell sharply" and len(found.nearest) == 3
    with pytest.warns(UserWarning, match="stock market.*The nearest it knows"):
        next(model.stream("the stock market fell sharply", seconds=1.0))
