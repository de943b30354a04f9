"""Exported folders that are not whole, or name what is outside them, are refused in a sentence."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import huggingface_hub.hub_mixin
import numpy as np
import pytest

from motionloom.datasets.schema import UserError
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.pretrained import MotionModel, write_bundle

PARTS = ["stats", "tokenizer", "tma", "gpt", "face_tokenizer", "face_gpt", "face_vae", "face_diffusion"]


@pytest.fixture(scope="module")
def whole(small_run: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An exported folder (not to be changed)."""
    folder = tmp_path_factory.mktemp("export") / "model"
    write_bundle(small_run.folder, folder)
    return folder


@pytest.fixture
def model(whole: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(whole, tmp_path / "model"))


def change(path: Path, edit: Callable[[Any], Any]) -> None:
    data = json.loads(path.read_text())
    edit(data)
    path.write_text(json.dumps(data))


def test_the_folder_lists_its_parts(whole: Path) -> None:
    assert json.loads((whole / "bundle.json").read_text())["parts"] == PARTS
    assert {path.name for path in whole.iterdir() if path.is_dir()} == set(PARTS)


def test_the_hubs_helper_misses_nothing(whole: Path, small_run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[Any] = []
    monkeypatch.setattr(huggingface_hub.hub_mixin.logger, "warning", lambda *words: said.append(words))
    for folder in (whole, small_run.folder):
        assert MotionModel.from_pretrained(folder, device="cpu").bundle.device.type == "cpu"
    super(MotionModel, MotionModel).from_pretrained(whole)  # as it goes for a name on the hub
    assert not said


@pytest.mark.parametrize("part", PARTS)
def test_a_lost_part_is_named(part: str, model: Path) -> None:
    shutil.rmtree(model / part)
    with pytest.raises(UserError, match=f"bundle.json: its part '{part}' is not here"):
        Bundle.open(model)


def test_a_folder_of_before_opens(model: Path) -> None:
    """Without the list of parts, and without config.json."""
    change(model / "bundle.json", lambda facts: facts.pop("parts"))
    (model / "config.json").unlink()
    shutil.rmtree(model / "face_vae")
    assert set(MotionModel.from_pretrained(model).bundle.faces) == {"gpt", "diffusion"}


@pytest.mark.parametrize("name", ["../secret", "/etc", "..", ".", "", "a/b", "a\\b", "lost", "some/hub-name"])
def test_the_text_encoder_is_never_outside(name: str, model: Path) -> None:
    (model.parent / "secret").mkdir()
    (model / "a/b").mkdir(parents=True)
    change(model / "bundle.json", lambda facts: facts.update(text_encoder=name))
    with pytest.raises(UserError, match="neither 'minilm' nor a folder beside this file"):
        Bundle.open(model)


@pytest.mark.parametrize("part", ["../gpt", "gtp", "text"])
def test_a_part_is_one_that_is_known(part: str, model: Path) -> None:
    change(model / "bundle.json", lambda facts: facts["parts"].append(part))
    with pytest.raises(UserError, match=f"its part '{part}' is not here"):
        Bundle.open(model)


@pytest.mark.parametrize(
    ("part", "key"),
    [
        ("gpt", "text_dim"), ("gpt", "streams"), ("gpt", "pattern"), ("gpt", "prior"), ("tma", "text_dim"),
        ("tma", "max_frames"), ("face_diffusion", "motion_dim"), ("face_diffusion", "text_dim"),
    ],
)  # fmt: skip
def test_a_lost_fact_is_named(part: str, key: str, model: Path) -> None:
    path = model / part / "model.json"
    for edit, says in (
        (lambda facts: facts["extra"].update({key: None}), "= None is no "),
        (lambda facts: facts["extra"].pop(key), "is required"),
    ):
        change(path, edit)
        with pytest.raises(UserError, match=f"{part}/model.json: key 'extra.{key}' {says}"):
            Bundle.open(model)


def test_a_part_that_the_layout_does_not_have_is_named(model: Path) -> None:
    change(model / "tma/model.json", lambda facts: facts["extra"].update(part="wings"))
    with pytest.raises(UserError, match=r"model.json: key 'extra.part' = 'wings' is no part of layout"):
        Bundle.open(model)


def test_seeds_go_by_the_place_in_the_list(whole: Path) -> None:
    model = MotionModel.from_pretrained(whole)
    alone = model.generate(["a person waves"], seed=1, seconds=1.0)[0]
    again = model.generate(["a person waves"], seed=1, seconds=1.0)[0]
    second = model.generate(["a person walks", "a person waves"], seed=1, seconds=1.0)[1]
    np.testing.assert_array_equal(alone.features, again.features)
    assert not np.array_equal(alone.features, second.features)
    for given in ("wave", ["wave", ""]):
        with pytest.raises(UserError, match="captions"):
            model.generate(given, seconds=1.0)
