"""Exported models bring their text encoder along, whether it was a folder or a model of the hub."""

from __future__ import annotations

import importlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import huggingface_hub.constants
import huggingface_hub.errors
import numpy as np
import pytest
from rich.console import Console

from motionloom.datasets.schema import UserError
from motionloom.datasets.text.build import build_text_cache
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.exported import write_bundle
from motionloom.pipeline.runs.api import run_recipe
from motionloom.pipeline.runs.plan import Selection
from motionloom.pipeline.store import text as text_source

RECIPE = """
extends: t2m-gpt-tiny
name: own-encoder
hardware: {accelerator: cpu, threads: 1, convert_workers: 1}
stages:
  data: {clips: 24, min_seconds: 2.0, max_seconds: 5.0}
  tokenizer:
    net: {width: 8, depth: 1, code_dim: 8, num_codes: 8}
    train: {steps: 2, batch_size: 4}
  gpt:
    net: {layers: 1, dim: 16, heads: 2, ff: 16}
    train: {steps: 2, batch_size: 4}
"""
CAPTIONS = ["a person walks", "someone jumps"]
HUB_NAME = "nobody/tiny-clip"


@pytest.fixture(scope="module")
def models() -> Iterator[ModuleType]:
    """Makers of tiny text encoders."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[2] / "datasets" / "text"))
        yield importlib.import_module("test_text_cache")


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
    return [motion.joints for motion in Bundle.open(folder).generate(CAPTIONS, seconds=1.0, seed=3)]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "hub"), [("clip", False), ("distilbert", False), ("clip", True)])
def test_an_export_gives_the_runs_motions_when_nothing_else_is_left(
    kind: str, hub: bool, models: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With an encoder of a folder, named from where the run was started, and one of the hub's cache."""
    start, cache, exported = tmp_path / "start", tmp_path / "hub", tmp_path / "exported"
    start.mkdir()
    encoder: Path = getattr(models, f"tiny_{kind}")(start)
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
    assert str(tmp_path) not in (exported / "bundle.json").read_text(), "a place on the maker's machine"
    with pytest.raises(UserError, match=r"cannot be copied .*put the model back"):
        write_bundle(kept, tmp_path / "second")
    assert list((tmp_path / "second").iterdir()) == [], "nothing that looks like a model is left"


def test_the_hub_is_asked_when_its_cache_lacks_the_model(
    models: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoder = models.tiny_clip(tmp_path)
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


def test_another_model_at_the_same_place_is_refused(models: ModuleType, tmp_path: Path) -> None:
    encoder = models.tiny_distilbert(tmp_path)
    build_text_cache(tmp_path / "text/cache", CAPTIONS, str(encoder), progress=False)
    models.tiny_distilbert(tmp_path, seed=1)
    with pytest.raises(UserError, match="its weights are not those that encoded this run's captions"):
        text_source.copy_encoder(str(encoder), tmp_path / "text", tmp_path / "copy")
    assert not (tmp_path / "copy").exists()
