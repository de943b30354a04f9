"""A text stage read by another run: words that its own data did not say, and an export exported again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from motionloom.datasets.text.build import build_with_encoder
from motionloom.datasets.text.encoder import EncodedText
from motionloom.pipeline.contract.stage import Stage, stage_kind
from motionloom.pipeline.stages.data.prepare import TextConfig
from motionloom.pipeline.store import text
from motionloom.pipeline.store.files import write_json
from motionloom.pipeline.store.text import TextSource
from motionloom.pipeline.training.warm_start import same_encoder

CPU = torch.device("cpu")


class Letters:
    """Every letter a token: its place in the alphabet, in 4 columns."""

    name, dim = "letters:1", 4

    def encode(self, captions: Sequence[str]) -> EncodedText:
        longest = max(map(len, captions))
        tokens, mask = (
            np.zeros((len(captions), longest, 4), np.float32),
            np.zeros((len(captions), longest), bool),
        )
        for row, caption in enumerate(captions):
            tokens[row, : len(caption)] = np.array([[ord(c) - 96] * 4 for c in caption])
            mask[row, : len(caption)] = True
        return EncodedText(np.full((len(captions), 4), 0.5, np.float32), tokens, mask)


@pytest.fixture
def loaded(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Encoders that were loaded."""
    names: list[str] = []

    def load(name: str, device: str) -> Letters:
        names.append(name)
        return Letters()

    monkeypatch.setattr(text, "load_text_encoder", load)
    return names


def test_captions_come_from_the_cache_if_it_has_them_all(tmp_path: Path, loaded: list[str]) -> None:
    build_with_encoder(tmp_path / "cache", {"walk", "jump"}, Letters(), progress=False)
    source = TextSource(tmp_path, "own", CPU)
    tokens, mask = source.tokens(["jump", "walk"])
    assert not loaded
    want = Letters().encode(["jump", "walk"])
    np.testing.assert_array_equal(tokens, want.tokens)
    np.testing.assert_array_equal(mask, want.mask)
    tokens, mask = source.tokens(["jump", "run"])
    assert loaded == ["own"], "another run says other things"
    want = Letters().encode(["jump", "run"])
    np.testing.assert_array_equal(tokens, want.tokens)
    np.testing.assert_array_equal(mask, want.mask)


def exported(folder: Path) -> TextSource:
    """The text stage of an export, with an encoder of its own."""
    (folder / "text/encoder").mkdir(parents=True)
    (folder / "text/encoder/model.safetensors").write_bytes(b"weights")
    (folder / "text/encoder/code.py").write_text("print('no')")
    write_json(folder / "text/text.json", {"encoder": "encoder", "dim": 4})
    write_json(folder / "bundle.json", {})
    return TextSource(folder / "text", "minilm", CPU, exported=True)


def test_an_export_has_no_cache_and_brings_its_encoder_along(tmp_path: Path, loaded: list[str]) -> None:
    source = exported(tmp_path)
    tokens, _ = source.tokens(["walk"])
    np.testing.assert_array_equal(tokens, Letters().encode(["walk"]).tokens)
    assert loaded == [str(tmp_path / "text/encoder")]
    source.export(tmp_path / "again")
    there = {path.relative_to(tmp_path / "again").as_posix() for path in (tmp_path / "again").rglob("*.*")}
    assert there == {"text.json", "encoder/model.safetensors"}, "and no code"
    assert TextSource(tmp_path / "again", "", CPU, exported=True).dim == 4


def test_text_stages_of_one_encoder(tmp_path: Path) -> None:
    """An export's says nothing in its config; the same folder may be written in several ways."""
    exported(tmp_path)
    place, kind = str(tmp_path / "text"), stage_kind("text", "here")
    other = str(tmp_path / "run/stages/text")
    given = {"near": "minilm", "far": f"{tmp_path}/text/../text/encoder", other: "minilm", place: "minilm"}
    stages = {n: Stage(n, kind, TextConfig(encoder=encoder), {"data": n}) for n, encoder in given.items()}
    assert same_encoder("near", other, stages) and same_encoder("near", "unknown", stages)
    assert same_encoder("far", place, stages)
    assert not same_encoder("near", place, stages) and not same_encoder("near", "far", stages)
