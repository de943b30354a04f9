"""A model by its name: those of the package, a mistyped folder, and what goes to the hub."""

from __future__ import annotations

import json
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.places import hub_is_away, means_folder, no_such_folder, require_hub_name
from motionloom.datasets.text.encoder import load_text_encoder
from motionloom.pipeline.cli.info import info
from motionloom.pipeline.cli.main import _exit_code
from motionloom.pipeline.inference import shipped_models as module
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.script import Script, ScriptSegment
from motionloom.pipeline.inference.shipped_models import model_folder, shipped_models

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


def test_a_model_here_goes_first_and_another_folder_hides_none(place: Path) -> None:
    Path("calm").mkdir()
    (Path("calm") / "00-dance.npz").write_text("what the model made")
    Path("lively").write_text("a file")
    assert model_folder("calm") == model_folder(Path("calm")) == place / "calm"
    assert model_folder("lively") == place / "lively" and model_folder("runs/calm") == Path("runs/calm")
    for file in ("recipe.yaml", "bundle.json"):
        (Path("calm") / file).write_text("{}")
        assert model_folder("calm") == Path("calm")
        (Path("calm") / file).unlink()
    Path("mine").mkdir()
    with pytest.raises(UserError, match="not a run folder"):
        Bundle.open("mine")


@pytest.mark.parametrize("opened", [Bundle.open, MotionModel.from_pretrained])
def test_an_unknown_name_lists_what_there_is(opened: Callable[[Any], Any], place: Path) -> None:
    with pytest.raises(UserError, match=r"zzz: .*: calm, lively$"):
        opened(Path("zzz"))
    with pytest.raises(UserError, match="did you mean lively"):
        opened("lvely")
    with pytest.raises(UserError, match=r"^runs/zzz: no such folder"):
        opened(Path("runs/zzz"))


@pytest.fixture
def synthetic() -> Path:
    """The folder of the model that ships."""
    if "synthetic" not in shipped_models():
        pytest.skip("this tree has no weights in models/pretrained/synthetic")
    return shipped_models()["synthetic"].folder


def test_the_model_that_ships_is_small_and_whole(synthetic: Path) -> None:
    assert shipped_models()["synthetic"].bytes <= 20e6
    before = torch.get_rng_state()
    model = MotionModel.from_pretrained("synthetic", device="cpu")
    assert torch.equal(torch.get_rng_state(), before)
    assert model.modalities == {"text"} and model.bundle.faces and model.bundle.layout.has("face")
    one, other = (model.generate([CAPTION], seconds=given) for given in (2.0, np.array([2], np.float32)))
    assert one[0].features.tobytes() == other[0].features.tobytes()
    with pytest.raises(UserError, match="devcie: no such option; did you mean 'device'"):
        MotionModel.from_pretrained("synthetic", devcie="cpu")
    for wrong, said in (({"sounds": ["a.wav"]}, "read a file by Sound.read"), ({"seconds": "3"}, "a number")):
        with pytest.raises(UserError, match=said):
            model.generate(None if "sounds" in wrong else [CAPTION], **wrong)
    for samples in (0, -1, 2.0, True):
        with pytest.raises(UserError, match=r"samples .*: a whole number, 1 or more"):
            model.perform(Script(segments=[ScriptSegment(text="a", seconds=1.0)]), samples=samples)


def test_the_readmes_first_line_waves_with_the_left_hand(
    synthetic: Path, call: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command as it stands in the README; its motion is judged by where the hands go."""
    monkeypatch.chdir(tmp_path)
    made = call("generate", "synthetic", CAPTION)
    assert made.code == 0, made.err
    assert "note:" not in made.err
    assert f"{tmp_path / 'motions/index.html'}" in made.err.splitlines()[-1]
    assert [Path(line).suffix for line in made.out.split()] == [".npz", ".html"]
    with np.load(made.out.split()[0], allow_pickle=False) as file:
        joints, facts = file["joints"].astype(np.float64), json.loads(str(file["metadata"]))
    assert facts["caption"] == CAPTION and len(joints) >= facts["fps"]
    number = {name: k for k, name in enumerate(facts["joint_names"])}

    def lifted(side: str) -> np.ndarray:
        """How far a wrist is above its elbow, frame by frame, metres."""
        return joints[:, number[f"{side}_wrist"], 1] - joints[:, number[f"{side}_elbow"], 1]

    assert (lifted("left") > 0.1).mean() > 0.3 and (lifted("right") < 0.1).mean() > 0.9
    told = call("caption", made.out.split()[0], "--k", 1)  # by the package's captioner
    assert told.code == 0 and "waves" in told.out and "left" in told.out


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder with two runs, where no name can be looked up."""
    for name in ("runs/humantomato-tiny", "runs/ude-tiny", "models"):
        (tmp_path / name).mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HF_ENDPOINT", raising=False)
    for name in ("https_proxy", "HTTPS_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)

    def unknown(*arguments: object) -> object:
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    return tmp_path


def test_which_names_mean_a_folder(here: Path) -> None:
    for name in ("./mine", "/data/mine", "~/mine", "../mine", "runs/tony", "a/b/c", "models/", "a b/c"):
        assert means_folder(name)
        with pytest.raises(UserError, match="no such folder"):
            require_hub_name(name)
    for name in ("owner/name", "sentence-transformers/all-MiniLM-L6-v2", "bert-base-uncased"):
        assert not means_folder(name)
        require_hub_name(name)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("runs/humantomato-tony", "did you mean runs/humantomato-tiny?"),
        ("ruins/ude-tiny", "did you mean runs?"),
        ("runs/zzz", "in runs: humantomato-tiny, ude-tiny"),
        ("zzz", "; here: models, runs"),
        ("models/a", "none is in models"),
    ],
)
def test_the_nearest_name_is_named(name: str, said: str, here: Path) -> None:
    assert no_such_folder(Path(name)).endswith(said)


def test_a_hub_that_cannot_be_reached_is_not_asked(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert hub_is_away()
    with pytest.raises(UserError, match="nobody/none: "):
        MotionModel.from_pretrained("nobody/none")
    with pytest.raises(UserError, match="in runs: humantomato-tiny"):
        load_text_encoder("runs/minilm")
    monkeypatch.setenv("https_proxy", "http://proxy:3128")  # which may know the hub
    assert not hub_is_away()


@pytest.mark.parametrize(
    "words", [["generate", "a walk"], ["edit", "a.bvh"], ["caption", "a.bvh"], ["serve"]], ids=" ".join
)
def test_the_commands_take_names_of_the_hub(
    words: list[str], here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["motionloom", words[0], "me/none", *words[1:]])
    assert _exit_code() == 2
    said = capsys.readouterr().err
    assert said.startswith("error: me/none: ")
    assert len(said.splitlines()) == 1
