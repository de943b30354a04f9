"""Exported folders that are not whole, or name what is outside them, are refused in a sentence."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import huggingface_hub.constants
import huggingface_hub.errors
import numpy as np
import pytest
from rich.console import Console
from text_samples import tiny_clip, tiny_distilbert

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import sha256_of
from motionloom.datasets.text.build import build_text_cache
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.exported import write_bundle
from motionloom.pipeline.inference.generation import generate
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.inference.shipped_models import model_folder
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.store import text as text_source
from motionloom.pipeline.store.artifact import Artifact

STAGES = [
    "stats", "text", "tokenizer", "tma", "gpt", "face_tokenizer", "face_gpt", "face_vae", "face_diffusion",
]  # fmt: skip


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


@pytest.fixture
def shipped(tmp_path: Path) -> Path:
    """A copy of the model of the package, which needs no training."""
    folder = model_folder("synthetic")
    if not folder.is_dir():
        pytest.skip("installed without its weights")
    return Path(shutil.copytree(folder, tmp_path / "model"))


def change(path: Path, edit: Callable[[Any], Any]) -> None:
    """Edit a file; one of a stage gets its new sha256, as a stranger would give it."""
    data = json.loads(path.read_text())
    edit(data)
    path.write_text(json.dumps(data))
    if path.name not in ("bundle.json", "artifact.json"):
        sealed = {path.name: {"bytes": path.stat().st_size, "sha256": sha256_of(path)}}
        change(path.parent / "artifact.json", lambda facts: facts["outputs"].update(sealed))


def test_the_folder_lists_its_stages(whole: Path) -> None:
    facts = json.loads((whole / "bundle.json").read_text())
    assert facts["generators"] == ["gpt", "face_gpt", "face_vae", "face_diffusion"]
    found = {path.parent.name: Artifact.load_json(path) for path in whole.glob("*/artifact.json")}
    assert set(found) == {path.name for path in whole.iterdir() if path.is_dir()} == set(STAGES)
    inputs = {name: {role: one.stage for role, one in made.inputs.items()} for name, made in found.items()}
    assert inputs["gpt"] == {"tokenizer": "tokenizer", "text": "text", "tma": "tma"}
    assert inputs["face_gpt"] == {"tokenizer": "face_tokenizer", "text": "text"}


def test_a_lost_stage_is_named(model: Path) -> None:
    for stage in STAGES:
        (model / stage).rename(model.parent / stage)
        with pytest.raises(UserError, match=f"bundle.json: its stage '{stage}' is not here"):
            Bundle.open(model)
        (model.parent / stage).rename(model / stage)


@pytest.mark.parametrize("text", ['{"parts": ["gpt"]}', '{"format": 2}', "[]", "{", "\x00"])
def test_a_folder_of_another_version_is_refused(text: str, model: Path) -> None:
    (model / "bundle.json").write_text(text)
    with pytest.raises(UserError, match=r"bundle.json: .*again"):
        MotionModel.from_pretrained(model)


@pytest.mark.parametrize("name", ["../secret", "/etc", "..", ".", "", "a/b", "a\\b", "lost", "some/hub-name"])
def test_the_text_encoder_is_never_outside(name: str, model: Path) -> None:
    (model.parent / "secret").mkdir()
    (model / "a/b").mkdir(parents=True)
    change(model / "text/text.json", lambda facts: facts.update(encoder=name))
    with pytest.raises(UserError, match=r"text\.json.*minilm"):
        MotionModel(model).generate(["a person waves"], seconds=1.0)


def test_the_encoder_of_the_config_is_not_followed(model: Path) -> None:
    """What a text stage was configured with is a place on another machine."""
    change(model / "text/artifact.json", lambda facts: facts["config"].update(encoder="/etc"))
    assert MotionModel(model).generate(["a person waves"], seconds=1.0)
    (model / "text/text.json").unlink()
    with pytest.raises(UserError, match=r"text.json: is gone"):
        MotionModel(model).generate(["a person waves"], seconds=1.0)


@pytest.mark.parametrize("name", ["../gpt", "/etc", "..", ".", "", "gtp", "a/b"])
def test_a_stage_is_one_that_is_listed_and_beside(name: str, model: Path) -> None:
    """Also one that is listed by a name that leads out of the folder."""
    shutil.copytree(model / "gpt", model.parent / "gpt")
    (model / "a/b").mkdir(parents=True)
    whole = (model / "bundle.json").read_text()
    change(model / "bundle.json", lambda facts: facts["generators"].append(name))
    with pytest.raises(UserError, match=f"its stage '{name}' is not here"):
        Bundle.open(model)
    (model / "bundle.json").write_text(whole)
    change(model / "gpt/artifact.json", lambda facts: facts["inputs"]["tokenizer"].update(stage=name))
    with pytest.raises(UserError, match=f"its stage '{name}' is not here|inputs.tokenizer.stage' = '{name}"):
        Bundle.open(model)


WRONG: dict[str, tuple[str, Callable[[Any], Any], str]] = {
    "a circle": (
        "tokenizer", lambda f: f["inputs"]["stats"].update(stage="gpt"), "its stage 'gpt' is not here"
    ),
    "itself": (
        "tokenizer", lambda f: f["inputs"]["stats"].update(stage="tokenizer"), "'tokenizer' is not here"
    ),
    "one elsewhere": (
        "gpt", lambda f: f["inputs"]["tokenizer"].update(folder="../tokenizer"), "'tokenizer' is not here"
    ),
    "an unknown kind": ("gpt", lambda f: f.update(kind="os"), "stage kind 'os' is not known here"),
    "another version": ("gpt", lambda f: f.update(version=99), "made by version 99 of stage kind gpt"),
    "a wrong config": ("gpt", lambda f: f["config"].update(priorr=1), "config: unknown key 'priorr'"),
    "no generator": ("", lambda f: f.update(generators=[]), "no finished stage here generates body motion"),
    "faces alone": ("", lambda f: f.update(generators=["face_vae"]), "here generates body motion"),
    "what does not generate": (
        "", lambda f: f["generators"].append("stats"), "'stats' .*generates nothing.*export the run again"
    ),
    "an input that is missing": (
        "gpt", lambda f: f["inputs"].pop("tokenizer"), "no finished 'tokenizer' stage here"
    ),
    "an input of another kind": (
        "gpt", lambda f: f["inputs"]["tokenizer"].update(stage="tma"), "'tma' of kind tma is no tokenizer"
    ),
    "an unknown key": ("", lambda f: f.update(code="os"), "unknown key 'code'"),
    "sampling of an unknown key": (
        "", lambda f: f.update(sampling={"cfg_scael": 1}), "sampling: unknown key 'cfg_scael'; did you mean"
    ),
    "a file elsewhere": (
        "gpt", lambda f: f["outputs"].update({"../x": {"bytes": 1, "sha256": ""}}), "no file of its folder"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_is_refused_in_a_sentence(name: str, model: Path) -> None:
    stage, edit, says = WRONG[name]
    change(model / stage / "artifact.json" if stage else model / "bundle.json", edit)
    with pytest.raises(UserError, match=says):
        MotionModel.from_pretrained(model)


@pytest.mark.parametrize(
    ("stage", "key"),
    [
        ("gpt", "text_dim"), ("gpt", "streams"), ("gpt", "pattern"), ("gpt", "prior"), ("tma", "text_dim"),
        ("tma", "max_frames"), ("face_diffusion", "motion_dim"), ("face_diffusion", "text_dim"),
    ],
)  # fmt: skip
def test_a_lost_fact_is_named(stage: str, key: str, model: Path) -> None:
    path = model / stage / "model.json"
    for edit, says in (
        (lambda facts: facts["extra"].update({key: None}), "= None is no "),
        (lambda facts: facts["extra"].pop(key), "is required"),
    ):
        change(path, edit)
        with pytest.raises(UserError, match=f"{stage}/model.json: key 'extra.{key}' {says}"):
            Bundle.open(model)


@pytest.mark.parametrize("name", ["gpt/model.safetensors", "gpt/model.json", "text/text.json"])
def test_files_that_were_changed_are_refused(name: str, shipped: Path) -> None:
    """One number of a network is another: it would load, and draw other motions."""
    data = bytearray((shipped / name).read_bytes())
    data[-2] ^= 1
    (shipped / name).write_bytes(data)
    with pytest.raises(UserError, match=f"{name}: is not"):
        Bundle.open(shipped)


@pytest.mark.parametrize(
    ("stage", "key", "value"),
    [
        ("gpt", "layers", 10**9),
        ("gpt", "dim", 6 * 10**9),
        ("gpt", "block_size", 10**12),
        ("tma", "layers", 10**9),
        ("tokenizer", "depth", 10**9),
        ("tokenizer", "num_codes", 10**10),
        ("face_gpt", "layers", 10**9),
    ],
)
def test_a_network_is_no_larger_than_its_weights(stage: str, key: str, value: int, shipped: Path) -> None:
    change(shipped / stage / "model.json", lambda facts: facts["config"].update({key: value}))
    with pytest.raises(UserError, match=f"{stage}/model.json"):  # built, it would take hours
        Bundle.open(shipped)


def test_an_export_draws_as_it_recommends(small_run: Any, call: Any, tmp_path: Path) -> None:
    """What is asked for goes first, field by field."""
    folder = tmp_path / "own"
    options = ("--set", "cfg_scale=1.5", "--set", "temperature=0")
    assert call("export", small_run.folder, "-o", folder, *options).code == 0
    model = MotionModel.from_pretrained(folder, device="cpu")
    assert model.bundle.recommended.model_dump(exclude_unset=True) == {"cfg_scale": 1.5, "temperature": 0.0}
    mixed = model.bundle.drawing(SamplingConfig(cfg_scale=2.0, top_p=0.8))
    assert mixed.model_dump(exclude_unset=True) == {"cfg_scale": 2.0, "temperature": 0.0, "top_p": 0.8}
    words = {"captions": ["a person waves"], "seconds": 1.0, "seed": 4}
    plain = Bundle.open(small_run.folder)
    (wanted,) = generate(plain, Request.of(**words, sampling=SamplingConfig(cfg_scale=1.5, temperature=0.0)))
    (made,) = model.generate(**words)
    np.testing.assert_array_equal(made.joints, wanted.joints)


# Exported models bring their text encoder along, whether it was a folder or a model of the hub.

RECIPE = """
extends: t2m-gpt-tiny
name: own-encoder
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data: {clips: 24, min_seconds: 2.0, max_seconds: 5.0}
  tokenizer: {net: {width: 8, depth: 1, code_dim: 8, num_codes: 8}, train: {steps: 2, batch_size: 4}}
  gpt: {net: {layers: 1, dim: 16, heads: 2, ff: 16}, train: {steps: 2, batch_size: 4}}
"""
CAPTIONS = ["a person walks", "someone jumps"]
HUB_NAME = "nobody/tiny-clip"


def train(folder: Path, encoder: str) -> Path:
    """A model on that encoder; returns the run folder."""
    (folder / "recipe.yaml").write_text(RECIPE)
    run = folder / "run"
    overrides = [f"text.encoder={encoder}"]
    run_recipe(
        folder / "recipe.yaml", run, overrides=overrides, select=Selection(until="gpt"),
        console=Console(quiet=True),
    )  # fmt: skip
    return run


def motions(folder: Path) -> list[np.ndarray]:
    return [motion.joints for motion in MotionModel(folder).generate(CAPTIONS, seconds=1.0, seed=3)]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "hub"), [("clip", False), ("distilbert", False), ("clip", True)])
def test_an_export_gives_the_runs_motions_when_nothing_else_is_left(
    kind: str, hub: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With an encoder of a folder, named from where the run was started, and one of the hub's cache."""
    start, cache, exported = tmp_path / "start", tmp_path / "hub", tmp_path / "exported"
    start.mkdir()
    encoder = (tiny_clip if kind == "clip" else tiny_distilbert)(start)
    (encoder / "pytorch_model.bin").write_bytes(b"pickled")
    if hub:
        monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(cache))
        monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
        stored = cache / f"models--{HUB_NAME.replace('/', '--')}"
        (stored / "refs").mkdir(parents=True)
        (stored / "refs/main").write_text("f00d")
        shutil.move(encoder, stored / "snapshots/f00d")
    monkeypatch.chdir(start)
    run = train(tmp_path, HUB_NAME if hub else encoder.name)
    assert StageCache().get(finished_stages(run)["text"]).encoder_name == (HUB_NAME if hub else str(encoder))
    kept = Path(shutil.copytree(run, tmp_path / "kept"))
    monkeypatch.chdir(tmp_path)
    wanted = motions(run)
    write_bundle(run, exported)
    for folder in (run, cache if hub else encoder):
        shutil.rmtree(folder)
    for made, first in zip(motions(exported), wanted, strict=True):
        np.testing.assert_array_equal(made, first)
    files = [path for path in (exported / "text/encoder").rglob("*") if path.is_file()]
    assert {path.suffix for path in files} <= {".safetensors", ".json", ".txt"} and files
    assert str(tmp_path) not in (exported / "bundle.json").read_text()
    with pytest.raises(UserError, match=r"cannot be copied .*put the model back"):
        write_bundle(kept, tmp_path / "second")
    assert list((tmp_path / "second").iterdir()) == []


def test_the_hub_is_asked_when_its_cache_lacks_the_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoder = tiny_clip(tmp_path)
    build_text_cache(tmp_path / "text/cache", CAPTIONS, str(encoder), progress=False)
    asked = []

    def download(name: str, *, allow_patterns: list[str], local_files_only: bool = False) -> str:
        assert name == HUB_NAME and "*.safetensors" in allow_patterns and "*.bin" not in allow_patterns
        asked.append(local_files_only)
        if local_files_only:
            raise huggingface_hub.errors.LocalEntryNotFoundError("not here")
        return str(encoder)

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    monkeypatch.setattr(text_source, "hub_is_away", lambda: False)
    text_source.copy_encoder(HUB_NAME, tmp_path / "text", tmp_path / "copy")
    assert asked == [True, False] and (tmp_path / "copy/model.safetensors").is_file()


def test_another_model_at_the_same_place_is_refused(tmp_path: Path) -> None:
    encoder = tiny_distilbert(tmp_path)
    build_text_cache(tmp_path / "text/cache", CAPTIONS, str(encoder), progress=False)
    tiny_distilbert(tmp_path, seed=1)
    with pytest.raises(UserError, match="weights are not those"):
        text_source.copy_encoder(str(encoder), tmp_path / "text", tmp_path / "copy")
    assert not (tmp_path / "copy").exists()
