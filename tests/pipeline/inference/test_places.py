"""A mistyped folder is answered at once with what is there; only what looks like it goes to the hub."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from motionloom.datasets.base.places import hub_is_away, means_folder, no_such_folder, require_hub_name
from motionloom.datasets.schema import UserError
from motionloom.datasets.text.encoder import load_text_encoder
from motionloom.pipeline.inference.pretrained import MotionModel


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


@pytest.mark.parametrize(
    ("name", "folder"),
    [
        ("./mine", True),
        ("/data/mine", True),
        ("~/mine", True),
        ("../mine", True),
        ("runs/humantomato-tony", True),
        ("some/more/parts", True),
        ("models/", True),
        ("with space/name", True),
        ("owner/name", False),
        ("sentence-transformers/all-MiniLM-L6-v2", False),
        ("bert-base-uncased", False),
    ],
)
def test_which_names_mean_a_folder(name: str, folder: bool, here: Path) -> None:
    assert means_folder(name) is folder
    if folder:
        with pytest.raises(UserError, match="no such folder"):
            require_hub_name(name)
    else:
        require_hub_name(name)


def test_the_nearest_name_is_named(here: Path) -> None:
    assert no_such_folder(Path("runs/humantomato-tony")) == (
        "runs/humantomato-tony: no such folder; did you mean runs/humantomato-tiny?"
    )
    assert no_such_folder(Path("ruins/ude-tiny")).endswith("did you mean runs?")
    assert no_such_folder(Path("runs/zzz")).endswith("in runs: humantomato-tiny, ude-tiny")
    assert no_such_folder(Path("zzz")).endswith("; here: models, runs")
    assert no_such_folder(Path("models/a")).endswith("and none is in models")


@pytest.mark.parametrize("name", ["runs/humantomato-tony", "./runs/x", "zzz", Path("zzz/yyy")])
def test_a_model_that_is_no_folder_is_answered_without_the_hub(
    name: str | Path, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def asked(*arguments: object, **options: object) -> object:
        raise AssertionError("the hub was asked")

    monkeypatch.setattr("huggingface_hub.hub_mixin.hf_hub_download", asked)
    monkeypatch.setattr("motionloom.pipeline.inference.pretrained.snapshot_download", asked)
    with pytest.raises(UserError, match="no such folder"):
        MotionModel.from_pretrained(name)


def test_a_hub_that_cannot_be_reached_is_not_asked_again_and_again(here: Path) -> None:
    assert hub_is_away()
    with pytest.raises(UserError, match=r"nobody/none: no such folder, .* cannot be reached from here"):
        MotionModel.from_pretrained("nobody/none")


def test_a_proxy_may_know_the_hub(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("https_proxy", "http://proxy:3128")
    assert not hub_is_away()


def test_a_text_encoder_that_is_no_folder_is_answered_without_the_hub(here: Path) -> None:
    with pytest.raises(UserError, match=r"runs/minilm: no such folder; in runs: humantomato-tiny"):
        load_text_encoder("runs/minilm")


def test_generate_names_the_nearest_run(here: Path, call: object) -> None:
    answer = call("generate", "runs/ude-tinny", "a person waves")  # type: ignore[operator]
    assert answer.code == 2 and answer.err.startswith("error: runs/ude-tinny: no such folder; did you mean")
