"""A URL where a command wants a path: refused in one sentence that says what can, and nothing is written."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from program import commands

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.register import discover
from motionloom.datasets.convert.registry import converter_named, names
from motionloom.pipeline.contract.stage import stage_kinds
from motionloom.pipeline.stages.data.data import ShardsStageConfig

URL = "s3://bucket/x"


def is_place(parameter: Any) -> bool:
    """Whether it takes a path, or text that names a folder or a file."""
    named = parameter.name in ("recipe", "run_folder", "run")
    return named or "Path" in str(parameter.type_descriptor.annotation)


def calls() -> Iterator[list[str]]:
    """Each command once for each of its places, the others being harmless."""
    discover()
    for name, command in commands():
        for place in command.params:
            if not is_place(place):
                continue
            words = list(name)
            for other in command.params:
                value = URL if other is place else "x"
                if other.param_type_name == "argument":
                    words.append(value)
                elif other is place or other.required:
                    words += [other.opts[0], value]
            yield words


CALLS = list(calls())


def test_all_commands_with_places_are_asked() -> None:
    assert len({tuple(words[:2]) for words in CALLS}) > 15 and ["data", "synth", URL] in CALLS


@pytest.mark.parametrize("words", CALLS, ids=" ".join)
def test_a_url_is_refused(
    words: list[str], call: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    answer = call(*words)
    assert answer.code == 2 and "Traceback" not in answer.err
    assert re.search(rf"{URL}: no URL .*data copy", answer.err), answer.err
    assert not list(tmp_path.iterdir())


def configs() -> Iterator[tuple[type[Config], str]]:
    discover()
    kinds = [kind.config for kind in stage_kinds().values()]
    for config in dict.fromkeys([*kinds, *(converter_named(name).config_class for name in names())]):
        for name, field in config.model_fields.items():
            if "Path" in str(field.annotation):
                yield config, name


@pytest.mark.parametrize(("config", "name"), configs(), ids=lambda value: getattr(value, "__name__", value))
def test_a_url_in_a_recipe_is_refused(config: type[Config], name: str, tmp_path: Path) -> None:
    required = {key: "x" for key, field in config.model_fields.items() if field.is_required()}
    together = ({"mean", "std"}, {"humanml_index", "humanml_texts"})
    required |= {key: "x" for pair in together if name in pair for key in pair}
    given = [URL] if "tuple[" in str(config.model_fields[name].annotation) else URL
    with pytest.raises(UserError, match=f"{URL}: no URL"):
        config.parse({**required, name: given}, "recipe")


def test_a_folder_named_like_a_url_is_reached_by_its_whole_path(
    call: Callable[..., Any], tmp_path: Path
) -> None:
    folder = tmp_path / "s3:" / "b"
    assert call("data", "synth", folder, "--clips", "2", "--workers", "1").code == 0
    assert call("data", "check", folder).code in (0, 1)
    shutil.rmtree(folder)


def test_a_file_url_in_a_recipe_is_its_folder(tmp_path: Path) -> None:
    assert ShardsStageConfig.parse({"path": f"file://{tmp_path}"}, "recipe").place == str(tmp_path)
